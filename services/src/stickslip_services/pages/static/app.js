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

for (const player of document.querySelectorAll(".player")) {
  const image = player.querySelector("img"), slider = player.querySelector("input"), play = player.querySelector(".play");
  const frames = Array.from({ length: +player.dataset.count }, (_, i) => {
    const frame = new Image();
    frame.src = `${player.dataset.pictures}${i}.png`;
    return frame;
  });
  const show = () => { image.src = frames[slider.value].src; image.alt = `frame ${+slider.value + 1} of ${frames.length}`; };
  let timer = null;
  slider.addEventListener("input", show);
  play.addEventListener("click", () => {
    if (timer) { clearInterval(timer); timer = null; } else {
      timer = setInterval(() => { slider.value = (+slider.value + 1) % frames.length; show(); }, 120);
    }
    play.textContent = timer ? "Stop" : "Play";
    play.setAttribute("aria-pressed", String(Boolean(timer)));
  });
}

for (const figure of document.querySelectorAll(".shape")) drawShape(figure);

async function drawShape(figure) {
  const canvas = figure.querySelector("canvas"), slider = figure.querySelector("input"), pen = canvas.getContext("2d");
  const answer = await fetch(figure.dataset.values);
  if (!answer.ok) return;
  const { points, triangles } = await answer.json();
  const finite = points.flat().filter((point) => point.every(Number.isFinite));
  const low = [0, 1, 2].map((k) => Math.min(...finite.map((point) => point[k])));
  const high = [0, 1, 2].map((k) => Math.max(...finite.map((point) => point[k])));
  const middle = low.map((value, k) => (value + high[k]) / 2);
  const scale = 0.8 * canvas.height / Math.hypot(...high.map((value, k) => value - low[k]));
  let turn = 0.6, tilt = 0.5;
  if (slider) slider.max = points.length - 1;
  const edges = triangles && [...new Set(triangles.flatMap(([a, b, c]) => [[a, b], [b, c], [c, a]]
    .map((edge) => Math.min(...edge) * 1e6 + Math.max(...edge))))].map((code) => [Math.floor(code / 1e6), code % 1e6]);
  const place = ([x, y, z]) => {
    const [u, v, w] = [x - middle[0], y - middle[1], z - middle[2]];
    const across = u * Math.cos(turn) - v * Math.sin(turn), deep = u * Math.sin(turn) + v * Math.cos(turn);
    return [canvas.width / 2 + scale * across, canvas.height / 2 - scale * (w * Math.cos(tilt) + deep * Math.sin(tilt))];
  };
  const draw = () => {
    const placed = points[slider ? slider.value : 0].map(place);
    pen.clearRect(0, 0, canvas.width, canvas.height);
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
  if (slider) slider.addEventListener("input", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
}
