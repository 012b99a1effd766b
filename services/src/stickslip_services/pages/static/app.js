// What htmx does not do: change events for parts of a page, copying, clips and shapes.
"use strict";

if (document.body.hasAttribute("data-live")) {
  const source = new EventSource("/ui/changes");
  source.addEventListener("change", () => document.body.dispatchEvent(new CustomEvent("server-change")));
}

document.addEventListener("click", async (event) => {
  const button = event.target.closest("button.copy");
  if (!button) return;
  await navigator.clipboard.writeText(button.parentElement.querySelector("pre").textContent);
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
});

for (const field of document.querySelectorAll("fieldset[data-values]")) {
  const values = JSON.parse(field.dataset.values), [from, to] = field.querySelectorAll("input");
  const show = (moved) => {
    if (+from.value > +to.value) (moved === from ? to : from).value = moved.value;
    const text = (value) => typeof value === "number" ? String(+value.toPrecision(4)) : value;
    field.querySelector("output").textContent = `${text(values[from.value])} to ${text(values[to.value])}`;
  };
  for (const input of [from, to]) input.addEventListener("input", () => show(input));
  show(from);
}

for (const view of document.querySelectorAll(".sample")) showSample(view);

// One cursor of time, an instant of the record, runs through the clip, its ground truth, the shapes and the curves.
async function showSample(view) {
  const slider = view.querySelector(".time"), play = view.querySelector(".play"), output = view.querySelector("output");
  const image = view.querySelector(".clip > img"), layer = view.querySelector("select");
  const instants = JSON.parse(view.dataset.frames), cursors = view.querySelectorAll(".cursor"), draws = [];
  let frames = [];
  const load = () => { frames = instants.map((_, i) => Object.assign(new Image(), { src: `${view.dataset.root}${layer.value}/${i}.png` })); };
  const show = () => {
    const now = slider ? +slider.value : 0, share = slider ? now / slider.max : 0;
    if (output) output.textContent = +view.dataset.rate ? `${(now / view.dataset.rate).toFixed(2)} s` : `frame ${now + 1}`;
    if (image) image.src = frames[Math.max(0, instants.findLastIndex((instant) => instant <= now))].src;
    for (const line of cursors) for (const end of ["x1", "x2"]) line.setAttribute(end, +line.dataset.from + share * (line.dataset.to - line.dataset.from));
    for (const draw of draws) draw(now);
  };
  if (image) load();
  if (layer) layer.addEventListener("change", () => { load(); show(); });
  if (slider) {
    let timer = null;
    const stride = Math.max(1, Math.round(slider.max / 60));
    slider.addEventListener("input", show);
    play.addEventListener("click", () => {
      if (timer) { clearInterval(timer); timer = null; } else {
        timer = setInterval(() => { slider.value = (+slider.value + stride) % (+slider.max + 1); show(); }, 80);
      }
      play.textContent = timer ? "Stop" : "Play";
      play.setAttribute("aria-pressed", String(Boolean(timer)));
    });
  }
  show();
  for (const figure of view.querySelectorAll(".shape")) {
    const draw = await drawShape(figure);
    if (draw) draws.push(draw);
    show();
  }
}

async function drawShape(figure) {
  const canvas = figure.querySelector("canvas"), pen = canvas.getContext("2d");
  const answer = await fetch(figure.dataset.values);
  if (!answer.ok) return null;
  const { points, triangles, steps, floor } = await answer.json();
  const finite = points.flat().filter((point) => point.every(Number.isFinite));
  const low = [0, 1, 2].map((k) => Math.min(...finite.map((point) => point[k])));
  const high = [0, 1, 2].map((k) => Math.max(...finite.map((point) => point[k])));
  if (floor) low[2] = Math.min(0, low[2]);
  const middle = low.map((value, k) => (value + high[k]) / 2);
  const scale = 0.8 * canvas.height / Math.hypot(...high.map((value, k) => value - low[k]));
  let turn = 0.6, tilt = 0.5, now = 0;
  const edges = triangles && [...new Set(triangles.flatMap(([a, b, c]) => [[a, b], [b, c], [c, a]]
    .map((edge) => Math.min(...edge) * 1e6 + Math.max(...edge))))].map((code) => [Math.floor(code / 1e6), code % 1e6]);
  const place = ([x, y, z]) => {
    const [u, v, w] = [x - middle[0], y - middle[1], z - middle[2]];
    const across = u * Math.cos(turn) - v * Math.sin(turn), deep = u * Math.sin(turn) + v * Math.cos(turn);
    return [canvas.width / 2 + scale * across, canvas.height / 2 - scale * (w * Math.cos(tilt) + deep * Math.sin(tilt))];
  };
  const ground = floor ? Array.from({ length: 9 }, (_, i) => [0, 1].map((k) => [0, 1].map((end) => {
    const spot = [0, 0, 0];
    spot[k] = low[k] + (high[k] - low[k]) * i / 8;
    spot[1 - k] = end ? high[1 - k] : low[1 - k];
    return spot;
  }))).flat() : [];
  const draw = () => {
    const placed = points[Math.max(0, steps.findLastIndex((step) => step <= now))].map(place);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.strokeStyle = getComputedStyle(document.body).getPropertyValue("--rule");
    pen.lineWidth = 1;
    pen.beginPath();
    for (const [from, to] of ground) { pen.moveTo(...place(from)); pen.lineTo(...place(to)); }
    pen.stroke();
    pen.strokeStyle = getComputedStyle(document.body).getPropertyValue("--accent");
    pen.lineWidth = edges ? 0.6 : 3;
    pen.lineJoin = "round";
    pen.beginPath();
    if (edges) for (const [a, b] of edges) { pen.moveTo(...placed[a]); pen.lineTo(...placed[b]); }
    else placed.forEach((point, i) => (i ? pen.lineTo(...point) : pen.moveTo(...point)));
    pen.stroke();
  };
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    turn += event.movementX / 120;
    tilt = Math.max(-1.5, Math.min(1.5, tilt + event.movementY / 120));
    draw();
  });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (!step) return;
    event.preventDefault();
    turn += step[0];
    tilt = Math.max(-1.5, Math.min(1.5, tilt + step[1]));
    draw();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  return (instant) => { now = instant; draw(); };
}
