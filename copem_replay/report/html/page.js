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

  // Pointing at a configuration, in a table, the key or a figure, shows it in all figures.
  const names = keys.map((key) => key.textContent);
  const drawnAs = (found) => Number(/-configuration-(\d+)-/.exec(found.id)[1]);
  const pointedAt = (target) => {
    const found = target.closest?.('[data-row], #key button[data-configuration], .plot [id*="-configuration-"]');
    if (!found) return -1;
    if (found.dataset.row !== undefined) return names.indexOf(found.dataset.row);
    return found.dataset.configuration === undefined ? drawnAs(found) : Number(found.dataset.configuration);
  };
  let pointed = -1;
  addEventListener("pointerover", (event) => {
    const k = pointedAt(event.target);
    if (k === pointed) return;
    pointed = k;
    document.documentElement.classList.toggle("pointed", k >= 0);
    for (const drawn of document.querySelectorAll('.plot [id*="-configuration-"]')) drawn.classList.toggle("at", drawnAs(drawn) === k);
    for (const row of document.querySelectorAll("tr[data-row]")) row.classList.toggle("at", k >= 0 && row.dataset.row === names[k]);
  });

  // Tables sort by a column, and a long one is filtered by words.
  const LONG = 8;
  const valueOf = (row, column) => {
    const cell = row.cells[column], value = parseFloat(cell.dataset.value ?? cell.textContent.replace("−", "-"));
    return Number.isNaN(value) ? cell.textContent.trim() : value;
  };
  const compare = (a, b) => {
    if (typeof a === typeof b) return typeof a === "number" ? a - b : a.localeCompare(b);
    return typeof a === "number" ? -1 : 1;
  };
  for (const table of document.querySelectorAll(".scroll > table")) {
    const body = table.tBodies[0], rows = [...body.rows];
    if (rows.length < 2 || !table.tHead) continue;
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const sorted = [...rows].sort((a, b) => (down ? -1 : 1) * compare(valueOf(a, column), valueOf(b, column)));
        body.append(...sorted);
      });
    });
    if (rows.length <= LONG) continue;
    const filter = document.createElement("input");
    filter.type = "search";
    filter.className = "screen filter";
    filter.placeholder = `filter ${rows.length} rows`;
    filter.setAttribute("aria-label", `filter rows of ${table.caption?.textContent || "the table"}`);
    filter.addEventListener("input", () => {
      const wanted = filter.value.toLowerCase();
      for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
    });
    table.parentElement.before(filter);
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
