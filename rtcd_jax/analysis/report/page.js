"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const scene = JSON.parse(document.getElementById("robots").textContent);
const touch = matchMedia("(pointer: coarse)").matches;
const narrow = matchMedia("(max-width: 600px)").matches;
const font = { family: "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif", size: 12, color: "#1c2733" };
const axis = { gridcolor: "#e9edf1", zeroline: false, linecolor: "#c6ced6", showline: true, ticks: "outside", automargin: true };
const legend = { orientation: "h", x: 0, y: 1, yanchor: "bottom", xanchor: "left", traceorder: "normal" };
const buttons = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
const config = { responsive: true, displaylogo: false, displayModeBar: !touch, modeBarButtons: buttons };

function layoutOf(name, own) {
  const layout = {
    font, margin: { l: 56, r: 12, t: own.title ? 34 : 12, b: 46 }, paper_bgcolor: "#fff", plot_bgcolor: "#fff",
    hovermode: name.startsWith("plane") ? "closest" : "x unified",
    legend,
    dragmode: touch ? false : "zoom",  // a finger scrolls the page
    ...own,
  };
  for (const key of Object.keys(own).filter((key) => key.startsWith("legend"))) layout[key] = { ...legend, ...own[key] };
  for (const key of Object.keys(layout).filter((key) => /^[xy]axis\d*$/.test(key))) {
    layout[key] = { ...axis, ...layout[key] };
    const title = layout[key].title;
    if (title) layout[key].title = { standoff: 8, ...title, font: { size: narrow ? 11 : 12 } };
  }
  if (own.title) layout.title = { ...own.title, font: { size: 13 }, x: 0.02, y: 0.98, yanchor: "top" };
  return layout;
}

const planar = [...document.querySelectorAll("[data-figure]")];
for (const box of planar) draw(box);

function draw(box) {
  const { data, layout, moments, pair } = figures[box.dataset.figure];
  const more = moments ? moving(pair) : [];
  Plotly.react(box, [...data, ...more], layoutOf(box.dataset.figure, layout), config);
}

// A robot's two motions in a plane: the disturbed one as a line, and where both are now.
function moving([i, j]) {
  return scene.robots.flatMap(({ color, label, disturbed }) => {
    const common = { legendgroup: label, showlegend: false, hoverinfo: "skip" };
    const marker = { size: 9, color, line: { color: "#fff", width: 1.5 } };
    return [
      { x: disturbed.x.map((x) => x[i]), y: disturbed.x.map((x) => x[j]), mode: "lines", line: { color, width: 1, dash: "dot" }, ...common },
      { x: [null], y: [null], mode: "markers", marker, ...common },
      { x: [null], y: [null], mode: "markers", marker: { ...marker, opacity: 0.55 }, ...common },
    ];
  });
}

// A plane's funnels over time: its outlines one behind the other.
function tubeOf({ data, layout, moments }) {
  const blocks = ({ source, points }, key) => {
    const values = data[source][key], rows = [];
    for (let first = 0; first < values.length; first += points) rows.push(values.slice(first, first + points - 1));
    return rows;
  };
  const traces = moments.flatMap((moment) => {
    const { times } = moment, color = data[moment.trace].line.color, name = data[moment.trace].legendgroup;
    const centers = data[moment.trace - moments.length];
    const common = { name, legendgroup: name, hoverinfo: "skip" };
    return [
      { type: "surface", x: blocks(moment, "x").map((row, k) => row.map(() => times[k])), y: blocks(moment, "x"), z: blocks(moment, "y"),
        surfacecolor: times.map(() => new Array(moment.points - 1).fill(0)), colorscale: [[0, color], [1, color]], showscale: false,
        opacity: 0.35, showlegend: true, ...common },
      { type: "scatter3d", mode: "lines", x: times, y: centers.x, z: centers.y, line: { color, width: 4 }, showlegend: false, ...common },
      { type: "scatter3d", mode: "lines", x: [null], y: [null], z: [null], line: { color, width: 6 }, showlegend: false, ...common },
    ];
  });
  const named = (title) => ({ title: { text: title }, gridcolor: "#e9edf1", zeroline: false, backgroundcolor: "#fff" });
  const scene3 = {
    dragmode: touch ? false : "turntable",
    xaxis: named("time [s]"), yaxis: named(layout.xaxis.title.text), zaxis: named(layout.yaxis.title.text),
    aspectmode: "manual", aspectratio: { x: 1.6, y: 1, z: 1 }, camera: { eye: { x: 0.9, y: -2.1, z: 0.8 } },
  };
  return [traces, { font, margin: { l: 0, r: 0, t: 24, b: 0 }, paper_bgcolor: "#fff", scene: scene3, legend, uirevision: "turned" }];
}

const tube = document.querySelector("[data-tube]");
const webgl = (() => { try { return !!document.createElement("canvas").getContext("webgl"); } catch { return false; } })();
const tubeConfig = { responsive: true, displaylogo: false, displayModeBar: !touch, modeBarButtons: [["toImage", "resetCameraDefault3d"]] };
let tubeDrawn = false;
function drawTube() {
  tubeDrawn = true;
  if (webgl) Plotly.react(tube, ...tubeOf(figures[tube.dataset.tube]), tubeConfig);
  else tube.textContent = "The funnel over time needs WebGL, which this browser does not offer.";
}
// Without a graphics card it takes seconds: not before it comes into sight.
new IntersectionObserver((entries, observer) => {
  if (!entries.some((entry) => entry.isIntersecting)) return;
  observer.disconnect();
  drawTube();
  showTube();
}, { rootMargin: "100px" }).observe(tube);

// The slider: robots and states of its time, and each funnel's ellipse at the knot nearest to it.
const slider = document.querySelector(".moment input");
const planes = planar.filter((box) => figures[box.dataset.figure].moments);
const latest = Math.max(...scene.robots.map((robot) => robot.times.at(-1)));
let now = 0;

function nearest(times, time) {
  let low = 0, high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle; else high = middle;
  }
  return time - times[low] <= times[high] - time ? low : high;
}

function cuts({ data, moments }, time) {
  return moments.map(({ source, times, points }) => {
    const knot = nearest(times, time), first = knot * points;
    return [times[knot], ...["x", "y"].map((key) => data[source][key].slice(first, first + points))];
  });
}

function showPlane(box) {
  const figure = figures[box.dataset.figure], [i, j] = figure.pair, first = figure.data.length;
  const ellipses = cuts(figure, now);
  const update = { x: ellipses.map((cut) => cut[1]), y: ellipses.map((cut) => cut[2]) };
  const traces = figure.moments.map((moment) => moment.trace);
  scene.robots.forEach((robot, number) => ["nominal", "disturbed"].forEach((name, which) => {
    const { x } = robot[name], k = nearest(robot.times, now), state = x[Math.min(k, x.length - 1)];
    update.x.push([state[i]]);
    update.y.push([state[j]]);
    traces.push(first + 3 * number + 1 + which);
  }));
  Plotly.restyle(box, update, traces);
}

function showTube() {
  if (!tubeDrawn || !webgl) return;
  const ellipses = cuts(figures[tube.dataset.tube], now);
  const update = { x: ellipses.map(([t, x]) => x.map(() => t)), y: ellipses.map((cut) => cut[1]), z: ellipses.map((cut) => cut[2]) };
  Plotly.restyle(tube, update, ellipses.map((_, i) => 3 * i + 2));
}

function show(time) {
  now = time;
  document.querySelector(".moment output").textContent = `${time.toFixed(2)} s`;
  drawRobots();
  planes.forEach(showPlane);
}

// Robots: every part is the hull of its points, as wide as the balls about them, the farthest drawn first.
let view = scene.view;
const svgs = [...document.querySelectorAll(".robot")].map((figure) => [figure, figure.querySelector("svg"), scene.robots[figure.dataset.robot]]);

function turned([w, x, y, z], [a, b, c]) {
  const [u, v, t] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u];
}

function hull(points) {
  const sorted = [...points].sort((p, q) => p[0] - q[0] || p[1] - q[1]);
  const half = (points) => {
    const chain = [];
    for (const p of points) {
      while (chain.length > 1) {
        const [a, b] = chain.slice(-2);
        if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
        chain.pop();
      }
      chain.push(p);
    }
    return chain.slice(0, -1);
  };
  return sorted.length < 3 ? sorted : [...half(sorted), ...half(sorted.reverse())];
}

function drawn(robot, pose, opacity, plain) {
  const parts = robot.parts.map((part) => {
    const [px, py, pz, ...turn] = pose[part.body];
    const seen = part.points.map((point) => {
      const [x, y, z] = turned(turn, point);
      return view.map(([a, b, c]) => a * (px + x) + b * (py + y) + c * (pz + z));
    });
    const depth = seen.reduce((sum, point) => sum + point[2], 0) / seen.length;
    const path = hull(seen).map(([x, y]) => `${x.toFixed(4)} ${(-y).toFixed(4)}`);
    const color = plain && part.body ? robot.color : part.color;
    return [depth, `<path d="M${path.join("L")}Z" fill="${color}" stroke="${color}" stroke-width="${(2 * part.radius).toFixed(4)}"/>`];
  });
  parts.sort((a, b) => a[0] - b[0]);
  return `<g opacity="${opacity}" stroke-linejoin="round" stroke-linecap="round">${parts.map((part) => part[1]).join("")}</g>`;
}

function drawRobots() {
  const reach = 1.06 * scene.reach;
  for (const [figure, svg, robot] of svgs) {
    const k = nearest(robot.times, now);
    const at = ({ poses }) => poses[Math.min(k, poses.length - 1)];
    svg.setAttribute("viewBox", `${-reach} ${-reach} ${2 * reach} ${2 * reach}`);
    svg.innerHTML = drawn(robot, at(robot.disturbed), 0.35, true) + drawn(robot, at(robot.nominal), 1, false);
    const ratio = robot.disturbed.ratio[Math.min(k, robot.disturbed.ratio.length - 1)];
    figure.querySelector("output").textContent = ratio === null ? "" : `disturbed: V/ρ = ${ratio.toPrecision(2)}`;
  }
}

for (const [, svg] of svgs) {
  let last = null;
  svg.addEventListener("pointerdown", (event) => { last = event; svg.setPointerCapture(event.pointerId); });
  svg.addEventListener("pointerup", () => { last = null; });
  svg.addEventListener("pointermove", (event) => {
    if (!last) return;
    const around = (event.clientX - last.clientX) / 120, over = touch ? 0 : (event.clientY - last.clientY) / 120;
    last = event;
    const [right, up, back] = view;
    const spin = ([x, y, z]) => [Math.cos(around) * x + Math.sin(around) * y, Math.cos(around) * y - Math.sin(around) * x, z];
    const mixed = (a, b, s, t) => a.map((value, i) => s * value + t * b[i]);
    const tipped = [right, mixed(up, back, Math.cos(over), -Math.sin(over)), mixed(back, up, Math.cos(over), Math.sin(over))];
    view = tipped.map(spin);
    drawRobots();
  });
}

slider.addEventListener("input", () => { stop(); show(slider.value * latest); showTube(); });

const play = document.querySelector(".play");
let begun = null;
function stop() { begun = null; play.textContent = "▶"; play.setAttribute("aria-label", "play"); }
play.addEventListener("click", () => {
  if (begun !== null) { stop(); showTube(); return; }
  const from = now < latest - 1e-6 ? now : 0;
  begun = performance.now() - 1000 * from;
  play.textContent = "❚❚";
  play.setAttribute("aria-label", "pause");
  const step = () => {
    if (begun === null) return;
    const time = Math.min((performance.now() - begun) / 1000, latest);
    slider.value = time / latest;
    show(time);
    if (time < latest) requestAnimationFrame(step); else { stop(); showTube(); }
  };
  step();
});

const select = document.querySelector(".pair select");
if (select) select.addEventListener("change", () => {
  const box = document.querySelector("[data-chosen]");
  box.dataset.figure = tube.dataset.tube = select.value;
  draw(box);
  showPlane(box);
  if (tubeDrawn) drawTube();
  showTube();
});

show(0);

// A click on a heading sorts its column: numbers as numbers, what is missing last.
function keyOf(row, column) {
  const cell = row.cells[column];
  if (cell.dataset.value !== undefined) return Number(cell.dataset.value);
  return cell.dataset.none === undefined ? cell.textContent : null;
}

function compare(a, b) {
  if (typeof a === "number" && typeof b === "number") return a - b;
  return String(a).localeCompare(String(b), undefined, { numeric: true });
}

for (const head of document.querySelectorAll("th")) {
  head.firstChild.addEventListener("click", () => {
    const table = head.closest("table");
    const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    for (const other of table.querySelectorAll("th")) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const body = table.tBodies[0];
    const keyed = [...body.rows].map((row) => ({ row, key: keyOf(row, head.cellIndex) }));
    keyed.sort((a, b) => (a.key === null) - (b.key === null) || (a.key === null ? 0 : sign * compare(a.key, b.key)));
    body.append(...keyed.map(({ row }) => row));
  });
}
