"use strict";
// Drag across a plot to look closer, wheel to go in and out, double click or the button for all of it.
document.querySelectorAll("figure.plot").forEach(function (figure) {
  var svg = figure.querySelector("svg"), area = figure.querySelector(".area");
  var box = svg.getAttribute("viewBox").split(" ").map(Number);
  var all = [box[0], box[0] + box[2], -box[1] - box[3], -box[1]], now = all.slice();
  var points = [];
  svg.querySelectorAll("path[data-series]").forEach(function (path) {
    var numbers = path.getAttribute("d").match(/-?\d+(?:\.\d+)?(?:e[-+]?\d+)? -?\d+(?:\.\d+)?(?:e[-+]?\d+)?/g) || [];
    numbers.forEach(function (pair) { var p = pair.split(" "); points.push([+p[0], -p[1]]); });
  });
  var button = document.createElement("button");
  button.type = "button"; button.textContent = "show all"; button.hidden = true;
  figure.querySelector("figcaption").appendChild(button);

  function ticks(low, high) {
    var raw = (high - low) / 5, power = Math.pow(10, Math.floor(Math.log10(raw))), out = [];
    var step = [1, 2, 5, 10].map(function (m) { return m * power; }).find(function (s) { return s >= raw * 0.999; });
    for (var k = Math.ceil(low / step - 1e-9); k <= Math.floor(high / step + 1e-9); k++) {
      out.push(+(k * step).toPrecision(10));
    }
    return out;
  }
  function write(element, values, side, place) {
    element.textContent = "";
    values.forEach(function (v) {
      var span = document.createElement("span");
      span.style[side] = 100 * place(v) + "%";
      span.textContent = String(+v.toPrecision(6));
      element.appendChild(span);
    });
  }
  function show(x0, x1) {
    if (!(x1 - x0 > 1e-6 * (all[1] - all[0]))) { return; }
    x0 = Math.max(x0, all[0]); x1 = Math.min(x1, all[1]);
    var y0 = all[2], y1 = all[3], whole = x0 <= all[0] && x1 >= all[1];
    if (!whole) {
      var seen = points.filter(function (p) { return p[0] >= x0 && p[0] <= x1; }).map(function (p) { return p[1]; });
      if (seen.length) {
        y0 = seen.reduce(function (a, b) { return Math.min(a, b); });
        y1 = seen.reduce(function (a, b) { return Math.max(a, b); });
        var margin = 0.06 * (y1 - y0) || 0.1 * Math.max(Math.abs(y1), 1e-6);
        y0 -= margin; y1 += margin;
      }
    }
    now = [x0, x1, y0, y1];
    svg.setAttribute("viewBox", [x0, -y1, x1 - x0, y1 - y0].join(" "));
    var across = ticks(x0, x1), up = ticks(y0, y1), lines = "";
    up.forEach(function (y) { lines += "<path class='" + (y === 0 ? "zero" : "grid") + "' d='M" + x0 + " " + -y + "H" + x1 + "'/>"; });
    svg.querySelector(".lines").innerHTML = lines;
    write(figure.querySelector(".across"), across, "left", function (v) { return (v - x0) / (x1 - x0); });
    write(figure.querySelector(".up"), up, "top", function (v) { return (y1 - v) / (y1 - y0); });
    button.hidden = whole;
  }
  function at(event) {
    var r = area.getBoundingClientRect();
    return now[0] + (now[1] - now[0]) * Math.min(1, Math.max(0, (event.clientX - r.left) / r.width));
  }
  var from = null, mark = document.createElement("div");
  mark.className = "mark"; mark.hidden = true; area.appendChild(mark);
  function left(v) { return 100 * (v - now[0]) / (now[1] - now[0]); }
  area.addEventListener("pointerdown", function (e) { from = at(e); area.setPointerCapture(e.pointerId); });
  area.addEventListener("pointermove", function (e) {
    if (from === null) { return; }
    var to = at(e);
    mark.hidden = false;
    mark.style.left = left(Math.min(from, to)) + "%";
    mark.style.width = Math.abs(left(to) - left(from)) + "%";
  });
  area.addEventListener("pointerup", function (e) {
    var to = at(e), a = Math.min(from, to), b = Math.max(from, to);
    mark.hidden = true;
    if (from !== null && b - a > 0.02 * (now[1] - now[0])) { show(a, b); }
    from = null;
  });
  area.addEventListener("pointercancel", function () { from = null; mark.hidden = true; });
  area.addEventListener("dblclick", function () { show(all[0], all[1]); });
  button.addEventListener("click", function () { show(all[0], all[1]); });
  area.addEventListener("wheel", function (e) {
    if (!e.ctrlKey && !e.shiftKey) { return; } // a plain wheel scrolls the page
    e.preventDefault();
    var c = at(e), f = e.deltaY > 0 ? 1.3 : 1 / 1.3;
    show(c - (c - now[0]) * f, c + (now[1] - c) * f);
  }, { passive: false });
});
