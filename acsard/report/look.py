"""The style sheet of a report and its script."""

STYLE = """
:root { color-scheme: light dark; --ink: #1c2127; --soft: #59636e; --paper: #fff; --card: #f5f7f9;
  --rule: #dde2e7; --bad: #c22f2f; --warn: #9a5b00 }
@media (prefers-color-scheme: dark) { :root { --ink: #e6eaee; --soft: #a3adb8; --paper: #14181c;
  --card: #1d2328; --rule: #343c44; --bad: #ff8080; --warn: #ffb84d } }
@media print { :root { color-scheme: light; --ink: #000; --soft: #444; --paper: #fff; --card: #fff;
  --rule: #ccc; --bad: #a00; --warn: #7a4a00 } }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 20px 24px 48px; max-width: 1180px; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 8px 0 }
h2 { font-size: 1.15rem; margin: 34px 0 2px }
p { margin: 4px 0 10px; max-width: 75ch }
.soft, figcaption { color: var(--soft); font-size: .9rem; max-width: 85ch }
.lead { font-size: 1.1rem }
.note { border-left: 4px solid var(--warn); padding: 4px 12px; background: var(--card) }
figure { margin: 0; break-inside: avoid }
.picture { width: 100% }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 20px; padding: 12px 16px;
  background: var(--card); border: 1px solid var(--rule); border-radius: 8px; margin: 14px 0 }
dt { color: var(--soft) }
dd { margin: 0 }
table { border-collapse: collapse; width: 100%; font-size: .92rem }
th { text-align: left; color: var(--soft); font-weight: 500 }
th, td { padding: 5px 12px 5px 0; border-bottom: 1px solid var(--rule); vertical-align: top }
tr { break-inside: avoid }
.name { min-width: 11ch; overflow-wrap: normal }
summary { cursor: pointer; margin-top: 34px }
summary h2 { display: inline }
.time { white-space: nowrap; font-variant-numeric: tabular-nums }
.error { color: var(--bad); font-weight: 600 }
.warning { color: var(--warn); font-weight: 600 }
.keys { display: flex; flex-wrap: wrap; gap: 2px 18px; margin: 6px 0 0; font-size: .9rem;
  max-width: none }
.js-plotly-plot :is([class*="tick"] text, .annotation-text, .xtitle, .ytitle) {
  fill: var(--ink) !important }
.js-plotly-plot .gridlayer path { stroke: var(--rule) !important }
.js-plotly-plot .zerolinelayer path { stroke: var(--soft) !important }
@media (max-width: 600px) {
  body { padding: 12px 14px 40px }
  h1 { font-size: 1.3rem }
  dl { grid-template-columns: 1fr; gap: 0 }
  dd { margin-bottom: 8px }
  .rows thead { display: none }
  .rows tr { display: block; padding: 6px 0; border-bottom: 1px solid var(--rule) }
  .rows td { display: inline; border: 0; padding: 0 8px 0 0 }
  .rows td.name { font-weight: 600 }
  .settings td:last-child::before { content: "default " }
  .rows td:last-child { color: var(--soft) }
}
@media print { .modebar { display: none } }
body.paper { width: 180mm; padding: 0 }
@page { size: A4; margin: 14mm }
"""

PROGRAM = """
"use strict";
const boxes = [], timed = [];
const look = { responsive: true, displaylogo: false, plotlyServerURL: "",
  modeBarButtons: [["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]] };
for (const one of JSON.parse(document.getElementById("pictures").textContent)) {
  const box = document.getElementById(one.name);
  // A finger that scrolls the page must not draw a frame in the picture.
  if (matchMedia("(pointer: coarse)").matches) one.layout.dragmode = false;
  Plotly.newPlot(box, one.data, one.layout, look);
  boxes.push(box);
  if (one.timed) timed.push(box);
}
let following = false;
for (const box of timed) box.on("plotly_relayout", async change => {
  const all = "xaxis.autorange" in change, [from, to] = box.layout.xaxis.range;
  if (following || !(all || "xaxis.range[0]" in change)) return;
  following = true;
  for (const other of timed) if (other !== box)
    await Plotly.relayout(other, { "xaxis.range": [from, to] });
  following = false;
});
const paper = on => {
  document.body.classList.toggle("paper", on);
  if (on) for (const one of document.querySelectorAll("details")) one.open = true;
  for (const box of boxes)  // at once: the browser does not wait
    Plotly.relayout(box, on ? { width: box.clientWidth } : { width: null, autosize: true });
};
addEventListener("beforeprint", () => paper(true));
addEventListener("afterprint", () => paper(false));
"""
