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
  const curves = tables.flatMap(({ curves, dots, dashed }) => Object.keys(curves).map((label, i) => ({ label, colour: dashed ? i : null, ...(dots && { paths: () => null, points: { show: true } }), ...(dashed && { dash: [6, 4] }) })));
  const value = (_, shown) => (shown === null || shown === undefined ? "–" : `${+shown.toPrecision(4)}`);
  const size = () => ({ width: figure.clientWidth, height: 150 });
  let now = 0;
  const plot = new uPlot({
    ...size(),
    series: [{ label: x, value }, ...curves.map((curve, i) => ({ ...curve, value, stroke: css(`--c${(curve.colour ?? i) % 6}`), width: 1.5 }))],
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
    plot.setLegend({ idx: plot.valToIdx(now) });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plot.redraw(false));
  new ResizeObserver(() => plot.setSize(size())).observe(figure);
}

// One cursor of time, an instant of the record, runs through the clip, its ground truth, the view in space and the curves.
function showSample(view) {
  const slider = view.querySelector(".time"), play = view.querySelector(".play"), output = view.querySelector("output");
  const layer = view.querySelector(".layer"), rate = +view.dataset.rate;
  // Samples of two datasets may have other rates: the cursor counts instants of the first one.
  const own = (part) => (+part.dataset.rate && rate ? now * +part.dataset.rate / rate : now) + 1e-6;
  const screens = [...view.querySelectorAll("[data-root]")].filter((clip) => clip.querySelector(".screen"))
    .map((clip) => ({ clip, frames: JSON.parse(clip.dataset.frames), ...makeScreen(clip) }));
  const instants = screens[0]?.frames ?? [];
  let now = 0;
  const show = () => {
    if (output) output.textContent = rate ? `${(now / rate).toFixed(2)} of ${(slider.max / rate).toFixed(2)} s` : `frame ${Math.floor(now) + 1}`;
    for (const { clip, frames, show } of screens) show(Math.max(0, frames.findLastIndex((instant) => instant <= own(clip))));
    view.dispatchEvent(new CustomEvent("instant", { detail: Math.floor(now) }));
  };
  const go = (instant) => { now = instant; slider.value = Math.floor(now); show(); };
  const load = () => { for (const screen of screens) screen.load(layer.value); };
  if (layer) load();
  layer?.addEventListener("change", () => { load(); show(); });
  if (slider) {
    const speed = view.querySelector(".speed"), pace = rate || 10;
    let playing = null;
    const tick = (before) => (moment) => {
      if (!playing) return;
      go((now + (moment - before) / 1000 * pace * +speed.value) % (+slider.max + 1));
      playing = requestAnimationFrame(tick(moment));
    };
    slider.addEventListener("input", () => { now = +slider.value; show(); });
    play.addEventListener("click", () => {
      if (playing) { cancelAnimationFrame(playing); playing = null; } else { playing = requestAnimationFrame((moment) => tick(moment)(moment)); }
      play.textContent = playing ? "Stop" : "Play";
      play.setAttribute("aria-pressed", String(Boolean(playing)));
    });
    // A step leads to the next frame of the clip, or to the next instant where there is no clip.
    const stops = instants.length ? instants : Array.from({ length: +slider.max + 1 }, (_, i) => i);
    for (const button of view.querySelectorAll(".step")) button.addEventListener("click", () => {
      const at = stops.findLastIndex((stop) => stop <= now) + +button.dataset.step;
      go(stops[Math.min(Math.max(at, 0), stops.length - 1)]);
    });
  }
  for (const figure of view.querySelectorAll(".space")) {
    const button = figure.querySelector(".load"), message = figure.querySelector(".message");
    button.addEventListener("click", async () => {
      button.disabled = true;
      message.textContent = "The motion is being loaded.";
      try {
        await (await import(view.dataset.space)).show(figure, () => Math.floor(own(figure)));
        message.textContent = "";
      } catch (error) {
        message.textContent = error.message;
      }
      button.remove();
    });
  }
  show();
}

// A clip as MP4, which is loaded as a whole so that any frame is at hand; as pictures where no MP4 can be played.
function makeScreen(clip) {
  const video = clip.querySelector("video"), picture = clip.querySelector("img.screen"), query = clip.dataset.query;
  let name = "", shown = 0, isVideo = Boolean(video);
  const draw = () => {
    // The middle of the frame, so that rounding leads to no other one.
    if (isVideo && video.readyState) video.currentTime = (shown + 0.5) / 10;
    else if (!isVideo) picture.src = `${clip.dataset.root}${name}/${shown}.png${query}`;
  };
  const fallBack = () => { isVideo = false; video.hidden = true; picture.hidden = false; draw(); };
  video?.addEventListener("loadedmetadata", draw);
  video?.addEventListener("error", fallBack);
  return {
    show(frame) { if (frame !== shown) { shown = frame; draw(); } },
    async load(layer) {
      name = layer;
      const file = `${clip.dataset.root}${layer}.mp4${query}`, link = clip.querySelector(".mp4");
      if (link) link.href = file;
      if (!isVideo) { draw(); return; }
      const answer = await fetch(file);
      if (!answer.ok) { fallBack(); return; }
      const old = video.src;
      video.src = URL.createObjectURL(await answer.blob());
      video.dataset.layer = layer;
      if (old) URL.revokeObjectURL(old);
    },
  };
}
