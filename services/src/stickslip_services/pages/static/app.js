// What htmx does not do: copying, sliders, plots and clips.
"use strict";

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

for (const figure of document.querySelectorAll("[data-plot]")) drawPlot(figure);
for (const view of document.querySelectorAll(".sample")) showSample(view);

function drawPlot(figure) {
  const { tables, x, y, log, timed } = JSON.parse(figure.dataset.plot), view = figure.closest(".sample");
  const css = (name) => () => getComputedStyle(figure).getPropertyValue(name).trim();
  const axis = { stroke: css("--quiet"), grid: { stroke: css("--rule"), width: 1 }, ticks: { show: false }, size: 50 };
  const scale = (values) => log && values.every((value) => value === null || value > 0)
    ? { time: false, distr: 3, range: (_, low, high) => [low / 1.1, high * 1.1] } : { time: false };
  const curves = tables.flatMap(({ curves, dots }) => Object.keys(curves).map((label) => ({ label, ...(dots && { paths: () => null, points: { show: true } }) })));
  const value = (_, shown) => (shown === null || shown === undefined ? "–" : `${+shown.toPrecision(4)}`);
  const size = () => ({ width: figure.clientWidth, height: 150 });
  let now = 0;
  const plot = new uPlot({
    ...size(),
    series: [{ label: x, value }, ...curves.map((curve, i) => ({ ...curve, value, stroke: css(`--c${i % 6}`), width: 1.5 }))],
    axes: [{ ...axis, size: 24 }, axis],
    scales: { x: scale(tables.flatMap((table) => table.x)), y: scale(tables.flatMap(({ curves }) => Object.values(curves).flat())) },
    hooks: { draw: [({ ctx, bbox, valToPos }) => {
      if (!timed) return;
      ctx.fillStyle = css("--bad")();
      ctx.fillRect(valToPos(now, "x", true), bbox.top, 1.5 * devicePixelRatio, bbox.height);
    }] },
  }, uPlot.join(tables.map(({ x, curves }) => [x, ...Object.values(curves)])), figure);
  figure.prepend(plot.root);
  figure.querySelector("canvas").ariaLabel = `${y} over ${x}`;
  if (timed) view.addEventListener("instant", ({ detail }) => {
    now = detail / view.dataset.rate;
    plot.redraw(false);
    plot.setLegend({ idx: detail });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plot.redraw(false));
  new ResizeObserver(() => plot.setSize(size())).observe(figure);
}

// One cursor of time, an instant of the record, runs through the clip, its ground truth, the view in space and the curves.
function showSample(view) {
  const slider = view.querySelector(".time"), play = view.querySelector(".play"), output = view.querySelector("output");
  const clips = [...view.querySelectorAll("[data-root]")], layer = view.querySelector("select");
  const instants = JSON.parse(view.dataset.frames);
  let frames = [];
  const load = () => {
    frames = clips.map(({ dataset }) => instants.map((_, i) => Object.assign(new Image(), { src: `${dataset.root}${layer.value}/${i}.png` })));
    for (const link of view.querySelectorAll(".mp4")) link.href = `${link.parentElement.dataset.root}${layer.value}.mp4`;
  };
  const show = () => {
    const now = slider ? +slider.value : 0;
    if (output) output.textContent = +view.dataset.rate ? `${(now / view.dataset.rate).toFixed(2)} s` : `frame ${now + 1}`;
    const frame = Math.max(0, instants.findLastIndex((instant) => instant <= now));
    if (layer) clips.forEach((clip, i) => { clip.querySelector("img").src = frames[i][frame].src; });
    view.dispatchEvent(new CustomEvent("instant", { detail: now }));
  };
  if (layer) load();
  layer?.addEventListener("change", () => { load(); show(); });
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
}
