"use strict";
(() => {
  const data = JSON.parse(document.getElementById("played").textContent);
  const player = document.getElementById("player");
  const find = (what) => player.querySelector(what);
  const slider = find(".moment"), button = find(".play"), clock = find("output"), list = find("tbody");
  const numbers = (text) => new Int16Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

  // Places: of each object pieces [first frame, frames, numbers, offset], of entries about no object by frame.
  const pieces = (text) => {
    const all = numbers(text), found = new Map();
    for (let at = 0; at < all.length; at += 3 + 3 * all[at + 2]) {
      if (!found.has(all[at])) found.set(all[at], []);
      found.get(all[at]).push([all[at + 1], all[at + 2], all, at + 3]);
    }
    return found;
  };
  const place = (tracks, object, frame) => {
    for (const [first, count, all, at] of tracks.get(object) || []) {
      if (frame >= first && frame < first + count) {
        const k = at + 3 * (frame - first);
        return [all[k] * data.unit, all[k + 1] * data.unit, (all[k + 2] / 32768) * Math.PI];
      }
    }
    return null;
  };
  const truth = pieces(data.truth);
  const configurations = data.configurations.map((one) => {
    const all = numbers(one.false), starts = [data.frames];
    for (let k = 0; k < data.frames; k++) starts.push(starts[k] + 2 * all[k]);
    return { ...one, tracks: pieces(one.tracks), all, starts };
  });
  const measured = new Map(data.measured.map(([object, onset, ended]) => [object, { onset, ended }]));
  const panels = [...player.querySelectorAll(".panel")].map((panel) => ({
    canvas: panel.querySelector("canvas"),
    choose: panel.querySelector("select"),
    counted: panel.querySelector(".counted"),
  }));

  const dark = matchMedia("screen and (prefers-color-scheme: dark)");
  const hue = (one) => (dark.matches ? one.dark : one.colour);
  let frame = 0, object = data.measured[0][0], zoom = 1, timer = 0;
  const instant = (k = frame) => data.from + k * data.step;
  const known = (one, k, at = instant()) => k in one.known && one.known[k] <= at + 1e-6;
  const shown = (panel) => configurations[Number(panel.choose.value)];
  const seconds = (one, k) =>
    k in one.known ? `${Math.max(0, one.known[k] - measured.get(k).onset).toFixed(2)} s` : "never";

  // The view: ahead of the ego is up; as wide as the chosen object wants, in steps.
  const WIDTHS = [60, 90, 120, 180, 240, 360];
  const view = (canvas, height) => {
    const width = canvas.clientWidth;
    let middle = null;
    for (let back = frame; back >= 0 && !middle; back--) middle = place(truth, data.ego, back);
    const looked = place(truth, object, frame);
    const [x, y, yaw] = middle || looked || [0, 0, 0];
    const turned = middle ? Math.PI / 2 - yaw : 0;
    const cos = Math.cos(turned), sin = Math.sin(turned);
    const local = (px, py) => [cos * (px - x) - sin * (py - y), sin * (px - x) + cos * (py - y)];
    const ratio = height / width, behind = middle ? 0.25 : 0.5;
    let wide = WIDTHS[0];
    if (looked) {
      const [across, ahead] = local(looked[0], looked[1]);
      const wanted = Math.max(2.2 * Math.abs(across), (1.1 * ahead) / ratio / (1 - behind), (-1.1 * ahead) / ratio / behind);
      wide = WIDTHS.find((each) => each >= wanted) || WIDTHS[WIDTHS.length - 1];
    }
    const scale = width / (wide * zoom);
    const at = (px, py) => {
      const [across, ahead] = local(px, py);
      return [width / 2 + across * scale, height * (1 - behind) - ahead * scale];
    };
    return { at, scale, turned, width, height };
  };

  const outline = (pen, seen, [x, y, yaw], length, width) => {
    const cos = Math.cos(yaw) / 2, sin = Math.sin(yaw) / 2;
    pen.beginPath();
    for (const [a, b] of [[1, 1], [-1, 1], [-1, -1], [1, -1]]) {
      pen.lineTo(...seen.at(x + a * length * cos - b * width * sin, y + a * length * sin + b * width * cos));
    }
    pen.closePath();
  };
  const cross = (pen, [x, y], size) => {
    pen.beginPath();
    pen.moveTo(x - size, y - size);
    pen.lineTo(x + size, y + size);
    pen.moveTo(x - size, y + size);
    pen.lineTo(x + size, y - size);
    pen.stroke();
  };

  const world = (pen, seen, tone) => {
    pen.lineWidth = 1;
    pen.fillStyle = tone("--line");
    pen.strokeStyle = tone("--edge");
    pen.globalAlpha = 0.5;
    for (const lane of data.lanes) {
      pen.beginPath();
      for (let k = 0; k < lane.length; k += 2) pen.lineTo(...seen.at(lane[k], lane[k + 1]));
      pen.stroke();
    }
    pen.globalAlpha = 1;
    for (const solid of data.solids) {
      pen.beginPath();
      for (let k = 0; k < solid.length; k += 2) pen.lineTo(...seen.at(solid[k], solid[k + 1]));
      pen.fill();
    }
    pen.fillStyle = tone("--faint");
    for (const k of truth.keys()) {
      const where = place(truth, k, frame), [, , length, width] = data.objects[k];
      if (!where) continue;
      outline(pen, seen, where, Math.max(length, 0.3), Math.max(width, 0.3));
      if (k === data.ego) pen.fill();
      pen.stroke();
    }
    pen.textAlign = "center";
    const few = data.units.length <= 6; // more names would lie on each other
    for (const [name, x, y] of data.units) pen.fillText(few ? `▲ ${name}` : "▲", ...seen.at(x, y));
  };

  const entries = (pen, seen, one) => {
    let marked = 0;
    pen.strokeStyle = pen.fillStyle = hue(one);
    for (const k of one.tracks.keys()) {
      const where = place(one.tracks, k, frame), [, , length, width] = data.objects[k];
      if (!where || k === data.ego) continue;
      outline(pen, seen, where, Math.max(length, 0.5), Math.max(width, 0.5));
      pen.globalAlpha = known(one, k) ? 0.85 : 0;
      pen.fill();
      pen.globalAlpha = 1;
      pen.lineWidth = 2;
      pen.stroke();
    }
    pen.lineWidth = 1.5;
    for (let at = one.starts[frame]; at < one.starts[frame + 1]; at += 2) {
      const [x, y] = [one.all[at] * data.unit, one.all[at + 1] * data.unit];
      pen.setLineDash([4, 3]);
      pen.beginPath();
      pen.arc(...seen.at(x, y), Math.max(7, 1.2 * seen.scale), 0, 2 * Math.PI);
      pen.stroke();
      pen.setLineDash([]);
      cross(pen, seen.at(x, y), 4);
      marked += 1;
    }
    return marked;
  };

  const LANE = 22;
  const chosen = (pen, seen, one, tone) => {
    const where = place(truth, object, frame), [name] = data.objects[object];
    if (!where) {
      pen.fillStyle = tone("--ink");
      pen.textAlign = "left";
      pen.fillText(`${name} is not there`, 8, 18);
      return;
    }
    const [x, y] = seen.at(where[0], where[1]);
    const inside = x >= 0 && x <= seen.width && y >= 0 && y <= seen.height;
    const [px, py] = [Math.min(Math.max(x, 26), seen.width - 26), Math.min(Math.max(y, 20), seen.height - 20)];
    pen.strokeStyle = pen.fillStyle = tone("--ink");
    pen.lineWidth = 1.5;
    if (inside) {
      pen.beginPath();
      pen.arc(x, y, Math.max(14, 1.6 * seen.scale), 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.font = "600 13px system-ui, sans-serif";
    const ego = place(truth, data.ego, frame);
    const far = ego ? ` ${Math.hypot(where[0] - ego[0], where[1] - ego[1]).toFixed(0)} m` : "";
    pen.textAlign = px > seen.width / 2 ? "right" : "left";
    pen.fillText(inside ? name : `${name} ▸${far}`, px + (px > seen.width / 2 ? -18 : 18), py - 14);
  };
  const lane = (pen, canvas, top, one, tone) => {
    const across = (canvas.clientWidth - 2) / Math.max(1, data.frames - 1);
    const { onset, ended } = measured.get(object);
    pen.fillStyle = tone("--line");
    pen.fillRect(0, top, canvas.clientWidth, LANE);
    pen.fillStyle = hue(one);
    for (const [first, count] of one.tracks.get(object) || []) pen.fillRect(first * across, top + LANE - 7, count * across, 3);
    if (object in one.known) {
      const begin = Math.max(0, (one.known[object] - data.from) / data.step) * across;
      pen.fillRect(begin, top + 3, Math.max(0, ((ended - data.from) / data.step) * across - begin), LANE - 12);
    }
    pen.strokeStyle = tone("--ink");
    pen.lineWidth = 1;
    for (const [at, dash] of [[onset, [2, 2]], [instant(), []]]) {
      pen.setLineDash(dash);
      pen.beginPath();
      pen.moveTo(((at - data.from) / data.step) * across + 1, top);
      pen.lineTo(((at - data.from) / data.step) * across + 1, top + LANE);
      pen.stroke();
    }
    pen.setLineDash([]);
  };

  const draw = () => {
    const styles = getComputedStyle(document.documentElement), tone = (name) => styles.getPropertyValue(name).trim();
    for (const { canvas, choose, counted } of panels) {
      const one = configurations[Number(choose.value)], sharp = devicePixelRatio || 1;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      canvas.width = Math.round(width * sharp);
      canvas.height = Math.round(height * sharp);
      const pen = canvas.getContext("2d");
      pen.scale(sharp, sharp);
      pen.lineJoin = "round";
      pen.font = "12px system-ui, sans-serif";
      pen.fillStyle = tone("--paper");
      pen.fillRect(0, 0, width, height);
      const seen = view(canvas, height - LANE);
      pen.save();
      pen.beginPath();
      pen.rect(0, 0, width, height - LANE);
      pen.clip();
      world(pen, seen, tone);
      const wrong = entries(pen, seen, one);
      chosen(pen, seen, one, tone);
      pen.restore();
      lane(pen, canvas, height - LANE, one, tone);
      let asked = 0, had = 0;
      for (const [k, { onset, ended }] of measured) {
        if (onset > instant() + 1e-6 || ended < instant() - 1e-6) continue;
        asked += 1;
        had += known(one, k) ? 1 : 0;
      }
      counted.textContent = `${had} of ${asked} known · ${wrong} false`;
    }
    clock.textContent = `${instant().toFixed(1)} s`;
    slider.value = String(frame);
    slider.setAttribute("aria-valuetext", clock.textContent);
    player.dataset.frame = String(frame);
    player.dataset.object = data.objects[object][0];
    const id = data.objects[object][0];
    find(".command").textContent = data.view.replace("OBJECT", /^[\w@%+=:,./-]+$/.test(id) ? id : `'${id}'`);
  };

  const stories = [...document.querySelectorAll("[data-story]")].filter((one) => one.dataset.log === data.log);
  const fill = () => {
    list.replaceChildren();
    for (const [k] of data.measured) {
      const row = list.insertRow(), head = document.createElement("th"), name = document.createElement("button");
      head.scope = "row";
      name.type = "button";
      name.textContent = `${data.objects[k][0]} ${data.objects[k][1]}`;
      name.setAttribute("aria-pressed", String(k === object));
      name.addEventListener("click", () => choose(k));
      head.append(name);
      row.append(head);
      for (const panel of panels) row.insertCell().textContent = seconds(shown(panel), k);
      const story = stories.find((one) => one.dataset.story === data.objects[k][0]);
      if (!story) continue;
      const link = document.createElement("a");
      link.href = `#${story.id}`;
      link.textContent = "story";
      row.insertCell().append(link);
    }
  };
  const go = (to) => {
    frame = Math.min(Math.max(to, 0), data.frames - 1);
    draw();
  };
  // Where the two differ, halfway between the instants at which they know the object; else at its onset.
  const begin = () => {
    const { onset, ended } = measured.get(object);
    const times = panels.map((panel) => Math.max(onset, Math.min(shown(panel).known[object] ?? ended, ended)));
    const at = times.length > 1 && times[0] !== times[1] ? (times[0] + times[1]) / 2 : onset;
    go(Math.ceil((at - data.from) / data.step - 1e-6));
  };
  const choose = (k) => {
    object = k;
    const buttons = [...list.querySelectorAll("button")];
    data.measured.forEach(([each], row) => buttons[row].setAttribute("aria-pressed", String(each === k)));
    begin();
  };
  const stop = () => {
    clearInterval(timer);
    timer = 0;
    button.textContent = "play";
  };
  const play = () => {
    if (timer) return stop();
    if (frame === data.frames - 1) go(0);
    button.textContent = "pause";
    timer = setInterval(() => (frame === data.frames - 1 ? stop() : go(frame + 1)), 1000 * data.step);
  };
  const next = (by) => {
    const row = data.measured.findIndex(([k]) => k === object) + by;
    choose(data.measured[(row + data.measured.length) % data.measured.length][0]);
  };
  const exchange = () => {
    if (panels.length < 2) return;
    const [a, b] = panels;
    [a.choose.value, b.choose.value] = [b.choose.value, a.choose.value];
    fill();
    draw();
  };
  const second = Math.max(1, Math.round(1 / data.step));
  const keys = {
    " ": play,
    ArrowLeft: (shift) => go(frame - (shift ? second : 1)),
    ArrowRight: (shift) => go(frame + (shift ? second : 1)),
    Home: () => go(0),
    End: () => go(data.frames - 1),
    n: () => next(1),
    p: () => next(-1),
    x: exchange,
    "+": () => ((zoom /= 1.25), draw()),
    "-": () => ((zoom *= 1.25), draw()),
  };
  player.addEventListener("keydown", (event) => {
    const own = event.target.tagName === "SELECT" || (event.key === " " && event.target.tagName === "BUTTON");
    if (own || event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key](event.shiftKey);
  });
  slider.addEventListener("input", () => go(Number(slider.value)));
  button.addEventListener("click", play);
  for (const panel of panels) panel.choose.addEventListener("change", () => (fill(), draw()));
  new ResizeObserver(draw).observe(player);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  // Links of the page, also below, to objects that are played here; other ones go.
  const played = (link) =>
    link.dataset.log === data.log && data.measured.find(([k]) => data.objects[k][0] === link.dataset.played);
  addEventListener("click", (event) => {
    const link = event.target.closest?.("a[data-played]");
    if (link) choose(played(link)[0]);
  });
  addEventListener("DOMContentLoaded", () => {
    for (const link of document.querySelectorAll("a[data-played]")) if (!played(link)) link.remove();
  });
  fill();
  begin();
})();
