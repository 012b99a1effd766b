// The view of a sample in three dimensions. It follows the cursor of time of its page.
import * as three from "./three.min.js";

const STATES = ["--open", "--stick", "--slip"]; // colours of the states of contact, by code

// `instant` gives the instant of this sample that the cursor of the page is at.
export async function show(figure, instant) {
  const canvas = figure.querySelector("canvas"), view = figure.closest(".sample");
  let renderer;
  try {
    renderer = new three.WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    canvas.remove();
    throw Error("This browser has no WebGL, which the view in three dimensions needs. Everything else is here.");
  }
  canvas.hidden = false;
  figure.querySelector(".legend").hidden = false;
  const answer = await fetch(figure.dataset.motion);
  if (!answer.ok) throw Error("The motion of this sample could not be read.");
  const motion = await answer.json(), paints = [], moves = [];
  const scene = new three.Scene(), camera = new three.PerspectiveCamera(35, 1, 1e-3, 1e3);
  camera.up.set(0, 0, 1);
  scene.add(camera.add(new three.DirectionalLight(0xffffff, 1.6)), new three.HemisphereLight(0xffffff, 0x777777, 1.6));

  const colour = (name) => new three.Color(getComputedStyle(figure).getPropertyValue(name).trim());
  const add = (object, name, poses) => {
    paints.push(() => object.material.color.copy(colour(name)));
    object.frustumCulled = false;
    if (poses) {
      object.matrixAutoUpdate = false;
      moves.push((step) => object.matrix.set(...poses[step], 0, 0, 0, 1));
    }
    scene.add(object);
    return object;
  };
  const solid = (geometry, name, poses) => add(new three.Mesh(geometry, new three.MeshLambertMaterial({ side: three.DoubleSide })), name, poses);
  const shape = ({ points, triangles }) => {
    const geometry = new three.BufferGeometry(), places = new three.BufferAttribute(new Float32Array(points[0].length), 3);
    geometry.setAttribute("position", places);
    if (triangles) geometry.setIndex(triangles);
    moves.push((step) => {
      points[Math.min(step, points.length - 1)].forEach((value, i) => { places.array[i] = value * motion.unit; });
      places.needsUpdate = true;
      if (triangles) geometry.computeVertexNormals();
    });
    return geometry;
  };

  const corners = (step) => Array.from({ length: step.length / 3 }, (_, i) => new three.Vector3().fromArray(step, 3 * i).multiplyScalar(motion.unit));
  const box = new three.Box3().setFromPoints(motion.sheets.flatMap((sheet) => sheet.points.flatMap(corners)));
  const extent = box.getSize(new three.Vector3()).length(), middle = box.getCenter(new three.Vector3());
  const grip = () => new three.BoxGeometry(0.03 * extent, 0.03 * extent, 0.03 * extent);
  for (const sheet of motion.sheets) {
    if (!sheet.triangles) { // a rod, with its clamp
      solid(new three.TubeGeometry(new three.CatmullRomCurve3(corners(sheet.points[0])), 300, 0.008), "--accent");
      solid(grip(), "--holder").position.copy(corners(sheet.points[0])[0]);
      continue;
    }
    const geometry = shape(sheet), cloth = solid(geometry, sheet.contact ? "--white" : "--open");
    if (sheet.contact) {
      const colours = new three.BufferAttribute(new Float32Array(sheet.points[0].length), 3);
      geometry.setAttribute("color", colours);
      cloth.material.vertexColors = true;
      moves.push((step) => {
        const known = STATES.map((name) => colour(name).toArray());
        [...sheet.contact[step]].forEach((code, i) => colours.array.set(known[code], 3 * i));
        colours.needsUpdate = true;
      });
    }
  }
  const cell = [5, 2, 1].map((factor) => factor * 10 ** Math.floor(Math.log10(extent / 4))).find((size) => size <= extent / 4);
  for (const body of motion.bodies) {
    if (body.type === "plane") {
      const grid = new three.GridHelper(12 * cell, 12), normal = new three.Vector3(...body.normal).normalize();
      grid.geometry.deleteAttribute("color").applyQuaternion(new three.Quaternion().setFromUnitVectors(new three.Vector3(0, 1, 0), normal));
      const at = middle.clone().divideScalar(cell).round().multiplyScalar(cell).projectOnPlane(normal);
      grid.geometry.translate(...at);
      add(grid, "--quiet", body.poses).material.vertexColors = false;
      figure.querySelector(".scale").textContent = `Cells of the floor: ${+(100 * cell).toPrecision(3)} cm.`;
    } else {
      const geometry = {
        sphere: () => new three.SphereGeometry(body.radius, 48, 24),
        capsule: () => new three.CapsuleGeometry(body.radius, body.length, 12, 32).rotateX(Math.PI / 2),
        cylinder: () => new three.CylinderGeometry(body.radius, body.radius, 2 * extent, 48, 1, true).rotateX(Math.PI / 2),
        box: () => new three.RoundedBoxGeometry(...body.size, 4, body.rounding),
        mesh: () => shape(body),
      }[body.type]();
      solid(geometry, "--body", body.poses);
    }
  }
  for (const { poses, holds } of motion.holders) {
    const jaws = solid(grip(), "--holder", poses);
    moves.push((step) => { jaws.visible = Boolean(holds[step][0]); });
  }

  const controls = new three.OrbitControls(camera, canvas), draw = () => renderer.render(scene, camera);
  const go = () => {
    const step = Math.max(0, motion.instants.findLastIndex((stored) => stored <= instant()));
    for (const move of moves) move(step);
    draw();
  };
  const repaint = () => { for (const paint of paints) paint(); go(); };
  view.addEventListener("instant", go);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  controls.target.copy(middle);
  // Two samples beside each other have one scale: that of the larger one.
  const place = (size) => {
    const far = 0.56 * size / Math.sin(Math.PI / 360 * camera.fov) / Math.min(1, canvas.clientWidth / canvas.clientHeight);
    camera.position.copy(middle).addScaledVector(new three.Vector3(0.5, -0.78, 0.38), far);
    controls.update();
    draw();
  };
  view.addEventListener("extent", ({ detail }) => place(detail));
  view.dataset.extent = Math.max(extent, +(view.dataset.extent ?? 0));
  view.dispatchEvent(new CustomEvent("extent", { detail: +view.dataset.extent }));
  controls.listenToKeyEvents(canvas);
  controls.addEventListener("change", draw);
  new ResizeObserver(() => {
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
    camera.aspect = canvas.clientWidth / canvas.clientHeight;
    camera.updateProjectionMatrix();
    draw();
  }).observe(canvas);
  repaint();
  figure.dataset.drawn = "";
}
