"use strict";

// Tables: a click on a heading sorts by its column, a second one the other way round.
function sort(button) {
  const heading = button.closest("th");
  const table = button.closest("table");
  const column = Number(heading.dataset.column);
  const first = heading.classList.contains("number") ? "descending" : "ascending";
  const other = first === "ascending" ? "descending" : "ascending";
  const order = heading.getAttribute("aria-sort") === first ? other : first;
  const sign = order === "ascending" ? 1 : -1;
  const key = (row) => row.cells[column].dataset.sort;
  const gaps = (a, b) => (key(a) === "") - (key(b) === ""); // last in either order
  const values = heading.classList.contains("number")
    ? (a, b) => Number(key(a)) - Number(key(b))
    : (a, b) => key(a).localeCompare(key(b));
  const compare = (a, b) => gaps(a, b) || sign * values(a, b);
  const body = table.tBodies[0];
  body.append(...[...body.rows].sort(compare));
  for (const each of table.querySelectorAll("th[aria-sort]")) each.setAttribute("aria-sort", "none");
  heading.setAttribute("aria-sort", order);
}
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => sort(button));
}

// Charts: drawn when they come into view, in the colours of the page.
function theme() {
  const style = getComputedStyle(document.documentElement);
  const value = (name) => style.getPropertyValue(name).trim();
  const axis = { color: value("--text"), gridcolor: value("--line"), linecolor: value("--line"), showgrid: true };
  return {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: value("--text"), family: "system-ui, sans-serif", size: 13 },
    hoverlabel: { bgcolor: value("--card"), font: { color: value("--text") } },
    xaxis: axis,
    yaxis: axis,
  };
}
function draw(place) {
  const chart = JSON.parse(document.getElementById(place.id + "-data").textContent);
  const colours = theme();
  const layout = { ...chart.layout, ...colours, autosize: true };
  for (const name of ["xaxis", "yaxis"]) layout[name] = { ...chart.layout[name], ...colours[name], automargin: true };
  Plotly.react(place, chart.data, layout, { responsive: true, displaylogo: false, displayModeBar: false });
}
const places = [...document.querySelectorAll(".chart")];
const drawn = new Set();
const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (entry.isIntersecting && !drawn.has(entry.target)) {
      drawn.add(entry.target);
      draw(entry.target);
    }
  }
}, { rootMargin: "400px" });
places.forEach((place) => watcher.observe(place));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawn.forEach(draw));

// Lists of lenses: those whose name contains every word of the filter.
for (const input of document.querySelectorAll("input[data-filters]")) {
  input.addEventListener("input", () => {
    const words = input.value.toLowerCase().split(/\s+/);
    for (const entry of document.querySelectorAll(input.dataset.filters)) {
      entry.hidden = !words.every((word) => entry.dataset.name.includes(word));
    }
  });
}
