"use strict";
(() => {
  const body = document.body;
  const drawable = (() => {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
  })();
  const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["sendDataToCloud"] };

  const draw = (figure) => {
    const source = document.getElementById(figure.dataset.plot);
    if (figure.classList.contains("drawn") || !source) return;
    const plot = JSON.parse(source.textContent);
    // Without WebGL there is no picture in space.
    if (plot.data.some((trace) => trace.type === "scatter3d") && !drawable) return;
    figure.classList.add("drawn");
    Plotly.newPlot(figure.querySelector(".plot"), plot.data, plot.layout, options);
  };
  const erase = (figure) => {
    if (!figure.classList.contains("drawn")) return;
    // A browser keeps few WebGL contexts: sweeps out of sight give theirs back.
    Plotly.purge(figure.querySelector(".plot"));
    figure.classList.remove("drawn");
  };

  const sweeps = [...document.querySelectorAll(".sweep")];
  const buttons = [...document.querySelectorAll("#chooser button")];
  const choose = (id) => {
    sweeps.forEach((sweep) => sweep.classList.toggle("chosen", sweep.id === id));
    buttons.forEach((button) => {
      const mine = button.dataset.sweep === id;
      button.setAttribute("aria-selected", String(mine));
      button.tabIndex = mine ? 0 : -1;
    });
    sweeps.forEach((sweep) => {
      const figures = sweep.querySelectorAll("figure[data-plot]");
      figures.forEach(sweep.id === id ? draw : erase);
    });
  };
  const fromAddress = () => {
    const id = location.hash.slice(1);
    if (sweeps.some((sweep) => sweep.id === id)) choose(id);
  };

  body.classList.add("scripted");
  buttons.forEach((button, i) => {
    button.addEventListener("click", () => choose(button.dataset.sweep));
    button.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = buttons[(i + step + buttons.length) % buttons.length];
      choose(next.dataset.sweep);
      next.focus();
    });
  });
  window.addEventListener("hashchange", fromAddress);
  // On paper every sweep is shown.
  window.addEventListener("beforeprint", () => document.querySelectorAll("figure[data-plot]").forEach(draw));
  document.querySelectorAll("main > figure[data-plot]").forEach(draw);
  if (sweeps.length) choose(sweeps[0].id);
  fromAddress();
})();
