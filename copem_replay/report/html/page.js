"use strict";
(() => {
  const keys = [...document.querySelectorAll("#key button[data-configuration]")];
  const left = new Set();

  const chosen = () => {
    for (const key of keys) {
      const k = Number(key.dataset.configuration);
      key.setAttribute("aria-pressed", String(!left.has(k)));
      for (const drawn of document.querySelectorAll(`.plot [id*="-configuration-${k}-"]`)) {
        drawn.classList.toggle("left-out", left.has(k));
      }
    }
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

  const opened = [];
  addEventListener("beforeprint", () => {
    for (const details of document.querySelectorAll("details:not([open])")) {
      details.open = true;
      opened.push(details);
    }
  });
  addEventListener("afterprint", () => {
    for (const details of opened.splice(0)) details.open = false;
  });
  document.documentElement.dataset.drawn = String(document.querySelectorAll(".plot").length);
})();
