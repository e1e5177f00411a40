"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const touch = matchMedia("(pointer: coarse)").matches;
const narrow = matchMedia("(max-width: 600px)").matches;
const font = { family: "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif", size: 12, color: "#1c2733" };
const axis = { gridcolor: "#e9edf1", zeroline: false, linecolor: "#c6ced6", showline: true, ticks: "outside", automargin: true };
const buttons = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
const config = { responsive: true, displaylogo: false, displayModeBar: !touch, modeBarButtons: buttons };

function layoutOf(name, own) {
  const layout = {
    font, margin: { l: 56, r: 12, t: own.title ? 34 : 12, b: 46 }, paper_bgcolor: "#fff", plot_bgcolor: "#fff",
    hovermode: name.startsWith("plane") ? "closest" : "x unified",
    legend: { orientation: "h", x: 0, y: 1, yanchor: "bottom", xanchor: "left", traceorder: "normal" },
    dragmode: touch ? false : "zoom",  // a finger scrolls the page
    ...own,
  };
  for (const key of Object.keys(layout).filter((key) => /^[xy]axis\d*$/.test(key))) {
    layout[key] = { ...axis, ...layout[key] };
    const title = layout[key].title;
    if (title) layout[key].title = { standoff: 8, ...title, font: { size: narrow ? 11 : 12 } };
  }
  if (own.title) layout.title = { ...own.title, font: { size: 13 }, x: 0.02, y: 0.98, yanchor: "top" };
  return layout;
}

const boxes = [...document.querySelectorAll(".plot")];
for (const box of boxes) {
  const { data, layout } = figures[box.dataset.figure];
  Plotly.newPlot(box, data, layoutOf(box.dataset.figure, layout), config);
}

// The slider: in every plane, each funnel's ellipse at the knot nearest to the time.
const slider = document.querySelector(".moment input");
const planes = boxes.filter((box) => figures[box.dataset.figure].moments);
const latest = Math.max(...planes.flatMap((box) => figures[box.dataset.figure].moments.map((m) => m.times.at(-1))));

function nearest(times, time) {
  let best = 0;
  times.forEach((t, k) => { if (Math.abs(t - time) < Math.abs(times[best] - time)) best = k; });
  return best;
}

function show(time) {
  document.querySelector(".moment output").textContent = `${time.toFixed(2)} s`;
  for (const box of planes) {
    const { data, moments } = figures[box.dataset.figure];
    const cuts = moments.map(({ source, times, points }) => {
      const first = nearest(times, time) * points;
      return ["x", "y"].map((key) => data[source][key].slice(first, first + points));
    });
    Plotly.restyle(box, { x: cuts.map((cut) => cut[0]), y: cuts.map((cut) => cut[1]) }, moments.map((m) => m.trace));
  }
}

slider.addEventListener("input", () => show(slider.value * latest));
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
