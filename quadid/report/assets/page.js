"use strict";
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const root = document.documentElement;
  const chosen = new Map();
  // Asked for once: to compute a style anew for every trace takes time. Forgotten when the page changes its dress.
  const colours = new Map();
  function colour(name) {
    if (!colours.has(name)) colours.set(name, getComputedStyle(root).getPropertyValue("--" + name).trim());
    return colours.get(name);
  }

  // Vehicles of a fleet, columns of a raw channel: colours that colour-blind eyes tell apart (Okabe and Ito), of middling lightness.
  const units = ["#0b78c4", "#d55e00", "#00916b", "#b8629a", "#8a7a00", "#3f9fd8", "#a05a2c", "#6a6fd0", "#5c8a2e", "#c0392b", "#00838f", "#7f7f7f"];

  function line(role) {
    if (role.startsWith("unit")) return { color: units[Number(role.slice(4)) % units.length], width: 1.2 };
    if (role === "measured") return { color: colour(role), width: 2.4 };
    if (role === "before") return { color: colour(role), width: 1.2, dash: "dot" };
    if (role === "floor") return { color: colour(role), width: 1, dash: "dash" };
    return { color: colour(role), width: 1.3 };
  }

  function marker(role) {
    if (role.startsWith("unit")) return { color: units[Number(role.slice(4)) % units.length], size: 6 };
    const symbols = { before: "line-ns-open", after: "circle", truth: "x-thin-open" };
    return { color: colour(role), size: role === "after" ? 9 : 14, symbol: symbols[role] || "circle", line: { width: 2, color: colour(role) } };
  }

  function painted(trace, view) {
    const out = Object.assign(view.x && !trace.x ? { x: view.x } : {}, trace);
    if ((trace.mode || "").includes("lines")) out.line = line(trace.role);
    if (trace.solid) out.line = { ...out.line, dash: "solid" };
    if (trace.edge) Object.assign(out, { line: { width: 0 }, fillcolor: trace.fill ? colour(trace.role) + "33" : undefined });
    if ((trace.mode || "").includes("markers")) out.marker = marker(trace.role);
    if ((trace.mode || "") === "lines+markers") Object.assign(out.marker, { symbol: trace.role === "before" ? "circle-open" : "circle", size: 7 });
    if (trace.error_y) out.error_y = Object.assign({ color: out.marker.color, thickness: 1.2, width: 0 }, trace.error_y);
    if (trace.error_x) out.error_x = Object.assign({ color: colour(trace.role), thickness: 2, width: 5 }, trace.error_x);
    if (trace.type === "heatmap") out.colorscale = [[0, colour("before")], [0.5, colour("card")], [1, colour("after")]];
    if (trace.type === "bar") out.marker = { color: colour(trace.role) };
    return out;
  }

  const raised = (text) => text.replace(/\^(\d)/g, (_, digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(digit)]);

  function layoutOf(view) {
    const axis = { gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line"), automargin: true, exponentformat: "power", ticklabeloverflow: "allow" };
    const layout = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: colour("ink"), size: 12, family: getComputedStyle(document.body).fontFamily },
      margin: { l: 60, r: 20, t: 8, b: 40 }, hovermode: "x unified", dragmode: "zoom",
      hoverlabel: { bgcolor: colour("card"), font: { color: colour("ink") } },
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
      xaxis: axis, yaxis: axis, // also of figures that say nothing about theirs
    };
    for (const [key, value] of Object.entries(view.layout)) {
      layout[key] = /^[xy]axis/.test(key) ? Object.assign({}, axis, value) : value;
      if (value && value.title) layout[key].title = { text: raised(value.title.text) };
    }
    // Copied, since Plotly would write into it, and dressed in the colour of its role.
    layout.shapes = (view.layout.shapes || []).map(({ role, ...shape }) => ({ ...shape, line: { color: colour(role), width: 1.5, dash: "dash" } }));
    return layout;
  }

  function draw(box) {
    const figure = figures[box.dataset.figure], number = chosen.get(figure.id) || 0;
    const view = figure.views[number];
    box.dataset.drawn = "yes";
    const size = { width: box.clientWidth, height: box.clientHeight };
    return Plotly.react(box, view.data.map((trace) => painted(trace, view)), { ...layoutOf(view), ...size }, { responsive: true, displaylogo: false, displayModeBar: false });
  }

  const boxes = () => document.querySelectorAll(".plot");
  const redraw = () => boxes().forEach((box) => { if (box.dataset.drawn) draw(box); });

  // A phone shows the verdict, the first part and the parameters; the rest unfolds where it is touched.
  if (window.matchMedia("(max-width: 640px)").matches) {
    const first = document.querySelector("main section:not(#verdict)");
    document.querySelectorAll("main details").forEach((part) => { part.open = part.open && part.parentElement === first; });
  }

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting && !entry.target.dataset.drawn) draw(entry.target);
    }
  }, { rootMargin: "600px" });
  boxes().forEach((box) => seen.observe(box));

  document.querySelectorAll("button[data-figure]").forEach((button) => {
    button.addEventListener("click", () => {
      const id = button.dataset.figure;
      chosen.set(id, Number(button.dataset.view));
      document.querySelectorAll("button[data-figure]").forEach((other) => {
        if (other.dataset.figure === id) other.setAttribute("aria-pressed", String(other === button));
      });
      draw(document.getElementById("plot-" + id));
    });
  });

  // Zoom from the keyboard: the window of the time axis, all axes back to their own with 0.
  const steps = { "+": [0.25, -0.25], "=": [0.25, -0.25], "-": [-0.5, 0.5], ArrowLeft: [-0.2, -0.2], ArrowRight: [0.2, 0.2] };
  boxes().forEach((box) => box.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !box.dataset.drawn) return;
    if (event.key === "0") { draw(box); return event.preventDefault(); }
    const step = steps[event.key];
    if (!step) return;
    const axis = box._fullLayout.xaxis, [low, high] = axis.range.map(Number), width = high - low;
    Plotly.relayout(box, { "xaxis.range": [low + step[0] * width, high + step[1] * width] });
    event.preventDefault();
  }));

  const system = window.matchMedia("(prefers-color-scheme: dark)");
  let own = null;
  function dress() {
    const dark = own === null ? system.matches : own;
    root.classList.toggle("dark", dark);
    colours.clear();
    root.style.colorScheme = dark ? "dark" : "light";
    redraw();
  }
  document.getElementById("theme").addEventListener("click", () => { own = !root.classList.contains("dark"); dress(); });
  system.addEventListener("change", dress);
  dress();

  // Paper: light colours, the parts that are open, every figure of theirs drawn, as wide as a page and less high.
  const PAGE = 690, FLAT = 0.7;
  window.addEventListener("beforeprint", () => {
    root.classList.remove("dark");
    colours.clear();
    boxes().forEach((box) => {
      if (box.closest("details:not([open])")) return;
      box.dataset.height = box.style.height;
      box.style.height = FLAT * parseFloat(box.style.height) + "px";
      box.style.width = PAGE + "px";
      draw(box);
    });
  });
  window.addEventListener("afterprint", () => {
    boxes().forEach((box) => {
      if (box.dataset.height) box.style.height = box.dataset.height;
      box.style.width = "";
      delete box.dataset.height;
    });
    dress();
  });
})();
