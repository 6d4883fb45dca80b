"use strict";
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const keys = [...document.querySelectorAll("#key button[data-configuration]")];
  const left = new Set();
  const config = (figure) => ({
    responsive: true,
    displaylogo: false,
    displayModeBar: figure.bar ? undefined : false,
    modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d", "zoom2d", "pan2d"],
  });
  const kept = (values) => values.filter((_, k) => !left.has(k));

  const draw = (figure) => {
    let { data, layout } = figure;
    if (figure.row && left.size) {
      data = data.map((trace) => ({
        ...trace, x: kept(trace.x), y: kept(trace.y), ...(trace.text ? { text: kept(trace.text) } : {}),
      }));
      layout = { ...layout, height: layout.height - figure.row * left.size };
    } else if (left.size) {
      data = data.map((trace) => ("meta" in trace ? { ...trace, visible: !left.has(trace.meta) } : trace));
    }
    // plotly.js writes into what it is given.
    return Plotly.react(figure.id, structuredClone(data), structuredClone(layout), config(figure));
  };

  const chosen = () => {
    for (const key of keys) key.setAttribute("aria-pressed", String(!left.has(Number(key.dataset.configuration))));
    for (const card of document.querySelectorAll(".card[data-configuration]")) {
      card.hidden = left.has(Number(card.dataset.configuration));
    }
    for (const figure of figures) if (figure.row || figure.data.some((trace) => "meta" in trace)) draw(figure);
    for (const plot of document.querySelectorAll(".card:not([hidden]) .plot")) Plotly.Plots.resize(plot);
  };
  for (const key of keys) {
    key.addEventListener("click", () => {
      const k = Number(key.dataset.configuration);
      if (!left.delete(k)) left.add(k);
      chosen();
    });
  }
  for (const button of document.querySelectorAll("#key button[data-every]")) {
    button.addEventListener("click", () => {
      left.clear();
      if (button.dataset.every === "none") keys.forEach((_, k) => left.add(k));
      chosen();
    });
  }

  // On paper a page is as wide as this, whatever the window is: 182 mm, two small figures side by side.
  const page = 688, small = 338;
  const opened = [];
  addEventListener("beforeprint", () => {
    for (const details of document.querySelectorAll("details:not([open])")) {
      details.open = true;
      opened.push(details);
    }
    for (const plot of document.querySelectorAll(".plot")) {
      Plotly.relayout(plot, { width: plot.closest(".card") ? small : page });
    }
  });
  addEventListener("afterprint", () => {
    for (const details of opened.splice(0)) details.open = false;
    for (const figure of figures) draw(figure);
  });

  Promise.all(figures.map(draw)).then(() => { document.documentElement.dataset.drawn = String(figures.length); });
})();
