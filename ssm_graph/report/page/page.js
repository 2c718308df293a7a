"use strict";
const charts = JSON.parse(document.getElementById("charts").textContent);
const options = { displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
const base = {
  margin: { l: 64, r: 12, t: 30, b: 44 }, hovermode: "closest",
  legend: { orientation: "h", yref: "container", y: 1, yanchor: "top", x: 0, itemsizing: "constant" },
  font: { family: "system-ui, 'Segoe UI', 'Liberation Sans', sans-serif", size: 13, color: "#1f2a33" },
  paper_bgcolor: "#ffffff", plot_bgcolor: "#ffffff",
};
const axis = { gridcolor: "#e3e3e3", zerolinecolor: "#c8d0d6", automargin: true };
const drawn = new Map();
// On paper: what fits between the margins of A4 and letter alike, and four charts to a page.
const paper = { width: 690, height: 0.62 };
let range = null, busy = false, prints = false;

function draw(name, size = {}) {
  if (drawn.has(name)) return drawn.get(name);
  const chart = charts[name], place = document.getElementById(name);
  const layout = { ...base, ...chart.layout, ...size };
  layout.xaxis = { ...axis, ...chart.layout.xaxis };
  layout.yaxis = { ...axis, ...chart.layout.yaxis };
  if (chart.is_time && range) layout.xaxis.range = range;
  const done = Plotly.newPlot(place, chart.traces, layout, options).then(() => {
    if (chart.is_time) place.on("plotly_relayout", (event) => link(name, event));
  });
  drawn.set(name, done);
  return done;
}

// Axes of time go together: what is zoomed in one chart is zoomed in all.
async function link(from, event) {
  if (busy) return;
  const isReset = event["xaxis.autorange"] === true;
  if (!isReset && event["xaxis.range[0]"] === undefined) return;
  range = isReset ? null : [event["xaxis.range[0]"], event["xaxis.range[1]"]];
  const change = { "xaxis.range": range ?? charts[from].layout.xaxis.range };
  busy = true;
  const others = [...drawn.keys()].filter((name) => name !== from && charts[name].is_time);
  await Promise.all(others.map((name) => Plotly.relayout(name, change)));
  busy = false;
}

const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (entry.isIntersecting) { seen.unobserve(entry.target); draw(entry.target.id); }
  }
}, { rootMargin: "400px" });
for (const name of Object.keys(charts)) seen.observe(document.getElementById(name));

function resize(name, height, size) {
  document.getElementById(name).style.height = `${height}px`;
  if (drawn.has(name)) Plotly.relayout(name, size);
  else draw(name, size);
}
window.addEventListener("resize", () => {
  if (!prints) drawn.forEach((_, name) => Plotly.Plots.resize(document.getElementById(name)));
});
window.addEventListener("beforeprint", () => {
  prints = true;
  for (const [name, chart] of Object.entries(charts)) {
    const height = Math.round(paper.height * chart.height);
    resize(name, height, { autosize: false, width: paper.width, height });
  }
});
window.addEventListener("afterprint", () => {
  prints = false;
  for (const [name, chart] of Object.entries(charts)) {
    resize(name, chart.height, { autosize: true, width: null, height: null });
  }
});
