// The photograph as an instrument, over the scene and under the panels: full size, zoom and pan to the
// pixel, outlines of one pixel, render, difference and depth, all views by what speaks against the pose.
// What is looked at is said by an element of the panel (`data-state`); pictures come by HTTP.
(() => {
  const LAYERS = ["photo", "render", "difference", "depth"], LONGEST_TRIES = 60;
  const SVG = "http://www.w3.org/2000/svg";
  let root = null, strip = null, at = 0, layer = "photo", isThree = false, spot = null, lines = true;
  let wanted = window.realsimPlace.photo(), turn = "0";
  let isLed = false; // to the worst view, until a person chooses one
  let zoom = 0, middle = [0, 0], seen = { state: "", whose: "" }, panes = [], asked = 0;

  const shown = () => document.querySelector("[data-realsim-photograph]");
  const whose = () => `${shown().dataset.scene}/${shown().dataset.instance}`;
  window.realsimShown = () => { // "0/3"; "0/3 0/4" while the photograph is still another object's
    const here = shown() ? whose() : "", named = root && root.dataset.named;
    return named && named !== here ? `${named} ${here}` : here;
  };
  const make = (tag, kind, parent, text) => {
    const e = document.createElement(tag);
    if (kind) e.className = kind;
    if (text) e.textContent = text;
    if (parent) parent.append(e);
    return e;
  };
  const address = (...parts) => {
    const { window: client, state } = shown().dataset;
    return ["/photograph", client, state, ...parts].join("/");
  };
  // A busy server may need longer than one request lasts; what it computed by then it keeps.
  const ask = async (...parts) => {
    let trouble = "the server does not answer";
    for (let k = 0; k < LONGEST_TRIES && root; ++k) {
      try {
        const response = await fetch(address(...parts));
        if (response.ok && response.headers.get("Content-Type") === "image/jpeg")
          return URL.createObjectURL(await response.blob());
        if (response.ok) {
          const said = await response.json();
          if (said.wait) { --k; continue; }
          if (said.error) { tell(said.error, true); throw new Refused(said.error); }
          return said;
        }
      } catch (error) {
        if (error instanceof Refused) return null;
        trouble = String(error);
      }
      await new Promise((done) => setTimeout(done, 500));
    }
    tell(trouble, true);
    return null;
  };
  class Refused extends Error {}
  const tell = (text, isBad) => {
    if (!root) return;
    const note = root.querySelector(".rs-note");
    note.textContent = text;
    note.classList.toggle("rs-bad", !!isBad);
  };

  // --- what is drawn --------------------------------------------------------------------------
  const row = () => strip && strip.views[at];
  const isDone = () => strip.compared >= strip.of;
  const share = (r) => r.trouble ? "cannot be read" : !r.is_compared ? "not compared" + (isDone() ? "" : " yet")
    : r.against === null ? "does not see it" : `${Math.round(100 * r.against)} % against`;
  const figure = (r) => r.trouble ? "\u2717" : !r.is_compared ? "\u2026" : r.against === null ? "\u2013" : Math.round(100 * r.against) + " %";
  const caption = () => {
    const name = shown().dataset.name, r = row();
    if (!r) return "";
    const words = [name, `view ${r.view}`];
    if (name) words.push(share(r) + (r.against === null ? "" : " the pose"));
    if (r.missing.length) words.push(`${r.missing.length} without a model`);
    return words.filter((w) => w).join(" \u00b7 ");
  };
  const room = () => {
    const pane = panes[0].box.getBoundingClientRect(), wide = innerWidth > 900 && !isThree;
    return { left: wide ? 246 : 0, width: pane.width - (wide ? 562 : 0), height: pane.height };
  };
  const fitted = () => Math.min(room().width / strip.width, room().height / strip.height);
  const place = () => {
    for (const p of panes) {
      const r = p.row, c = isThree && spot ? p.at : middle;
      const { left, width, height } = room();
      const x = left + width / 2 - zoom * (c[0] + 0.5), y = height / 2 - zoom * (c[1] + 0.5);
      p.image.style.transform = `translate(${x}px, ${y}px) scale(${zoom})`;
      p.image.style.imageRendering = zoom >= 2 ? "pixelated" : "auto";
      p.group.setAttribute("transform", `translate(${x} ${y}) scale(${zoom}) translate(0.5 0.5)`);
      p.head.textContent = isThree ? `view ${r.view} \u00b7 ${share(r)}` : "";
    }
    root.querySelector(".rs-zoom").textContent = `${zoom >= 1 ? zoom.toFixed(zoom < 3 ? 1 : 0) : zoom.toFixed(2)} x`;
  };
  const look = () => { // at the object, as large as a third of the room
    const r = row();
    middle = r && r.u != null ? [r.u, r.v] : [strip.width / 2, strip.height / 2];
    const size = r && r.u != null ? Math.min(room().width, room().height) / (4 * r.radius) : 0;
    zoom = Math.min(Math.max(size, fitted()), 16);
  };
  const load = (p) => {
    const source = address(layer, p.row.view);
    if (p.source !== source) {
      p.source = source;
      p.box.classList.add("rs-wait");
      ask(layer, p.row.view).then((picture) => {
        if (p.source !== source || !panes.includes(p)) return picture && URL.revokeObjectURL(picture);
        p.box.classList.remove("rs-wait");
        URL.revokeObjectURL(p.image.src);
        if (!picture) { p.image.removeAttribute("src"); return; } // why is told; no other view's stays
        if (!p.row.trouble && root.querySelector(".rs-note").classList.contains("rs-bad")) tell("");
        p.image.onload = () => { p.box.dataset.layer = source.split("/").at(-2); };
        p.image.width = strip.width; p.image.height = strip.height; p.image.src = picture;
      });
    }
    const drawn = address("outlines", p.row.view);
    if (p.drawn === drawn) return;
    p.drawn = drawn;
    ask("outlines", p.row.view).then((objects) => {
      if (!objects || p.drawn !== drawn || !panes.includes(p)) return;
      p.group.replaceChildren();
      for (const o of objects) for (const kind of ["hidden", "seen"]) {
        const path = document.createElementNS(SVG, "path");
        const d = o[kind].map((l) => "M" + l.join(" ")).join("");
        path.setAttribute("d", d);
        path.setAttribute("stroke", `rgb(${o.rgb})`);
        path.setAttribute("class", `rs-${kind}` + (String(o.instance) === shown().dataset.instance ? " rs-own" : ""));
        p.group.append(path);
      }
      for (const m of p.row.missing) {
        const ring = document.createElementNS(SVG, "circle");
        for (const [k, v] of Object.entries({ cx: m.u, cy: m.v, r: m.radius + 6, class: "rs-missing" })) ring.setAttribute(k, v);
        p.group.append(ring);
      }
      p.box.dataset.missing = JSON.stringify(p.row.missing.map((m) => [m.u, m.v, m.radius]));
    });
  };
  const draw = () => {
    if (!strip) return;
    let rows = [row()];
    if (isThree) {
      const sees = strip.views.filter((r) => spot ? spot.has(r.view) : r.u != null);
      rows = [row(), ...sees.filter((r) => r !== row())].slice(0, 3);
    }
    const box = root.querySelector(".rs-panes");
    while (panes.length > rows.length) panes.pop().box.remove();
    while (panes.length < rows.length) {
      const pane = make("div", "rs-pane", box), image = make("img", "", pane);
      const svg = document.createElementNS(SVG, "svg"), group = document.createElementNS(SVG, "g");
      svg.append(group); pane.append(svg);
      panes.push({ box: pane, image, group, head: make("b", "", pane) });
    }
    window.realsimPlace.tell(row().view);
    panes.forEach((p, k) => {
      p.row = rows[k];
      p.at = (spot && spot.get(p.row.view)) || (p.row.u != null ? [p.row.u, p.row.v] : middle);
      load(p);
    });
    if (!zoom) look();
    place();
    root.classList.toggle("rs-three", isThree);
    root.classList.toggle("rs-bare", !lines);
    root.dataset.whose = root.dataset.named = seen.whose; // scene and object that is drawn, and is named
    root.querySelector(".rs-caption").textContent = caption();
    root.querySelector(".rs-compared").textContent = isDone() ? "" : `${strip.compared} of ${strip.of} views compared`;
    if (row().trouble) tell(row().trouble, true);
    for (const b of root.querySelectorAll("[data-layer]")) b.ariaPressed = String(b.dataset.layer === layer);
    const legend = root.querySelector(".rs-legend");
    legend.replaceChildren();
    if (layer === "depth") {
      for (const [mm, rgb] of strip.legend)
        make("i", "", legend, (mm > 0 ? "+" : "") + +mm.toPrecision(2)).style.background = `rgb(${rgb})`;
      make("span", "", legend, "mm. " + strip.words);
    } else if (layer === "difference") make("span", "", legend, "black: the render is as the photograph; yellow: it is not");
    [...root.querySelectorAll(".rs-strip button")].forEach((b, k) => {
      b.ariaPressed = String(k === at);
      if (k === at) b.scrollIntoView({ block: "nearest", inline: "nearest" });
    });
  };
  // Nothing of another object stays: what one view says against it would be read as said of this one.
  const forget = () => {
    strip = null; panes = []; root.dataset.whose = ""; root.dataset.named = whose();
    for (const part of [".rs-panes", ".rs-strip", ".rs-legend"]) root.querySelector(part).replaceChildren();
    root.querySelector(".rs-caption").textContent = shown().dataset.name;
    root.querySelector(".rs-compared").textContent = "";
    tell("The views are being compared with the models ...");
  };
  const later = () => {
    clearTimeout(later.timer);
    later.timer = setTimeout(() => { if (root) renew(); }, 250);
  };
  const renew = async () => {
    const turn = ++asked, { state } = shown().dataset;
    let isOther = whose() !== seen.whose;
    if (isOther) { forget(); isLed = wanted === null; }
    do { // the server answers with what is compared by then; the views keep their places meanwhile
      const found = await ask("strip");
      if (!found || turn !== asked || !root) return;
      if (found.whose !== whose()) return later(); // another was chosen on the way
      const before = wanted ?? (strip && row().view), rank = new Map(strip ? strip.views.map((r, k) => [r.view, k]) : []);
      if (strip && found.compared < found.of) found.views.sort((a, b) => rank.get(a.view) - rank.get(b.view));
      seen = { state, whose: found.whose }; strip = found;
      const leads = isLed && (isOther || isDone());
      at = leads ? 0 : Math.max(strip.views.findIndex((r) => String(r.view) === String(before)), 0);
      if (isOther) { spot = null; tell(""); }
      if (isOther || (leads && row().view !== before)) zoom = 0;
      if (isDone()) isLed = false;
      wanted = null; isOther = false;
      list();
      draw();
    } while (!isDone());
  };
  const list = () => {
    const box = root.querySelector(".rs-strip"), views = strip.views;
    if ([...box.children].map((b) => b.dataset.view).join() !== views.map((r) => r.view).join()) {
      box.replaceChildren();
      views.forEach((r, k) => {
        const b = make("button", "", box), thumb = make("img", "", b);
        b.dataset.view = r.view; b.onclick = () => go(k);
        thumb.loading = "lazy"; thumb.alt = ""; thumb.src = address("thumb", r.view);
        make("span", "", b);
      });
    }
    [...box.children].forEach((b, k) => {
      b.title = `view ${views[k].view}: ${views[k].trouble || share(views[k])}`;
      b.lastChild.textContent = `${views[k].view}: ${figure(views[k])}`;
      b.className = views[k].against > 0.1 ? "rs-against" : "";
    });
  };
  const go = (k) => {
    if (!strip) return;
    isLed = false;
    if (root.querySelector(".rs-note").classList.contains("rs-bad")) tell(""); // of the view before
    at = (k + strip.views.length) % strip.views.length;
    const r = row();
    if (!isThree && spot && spot.has(r.view)) middle = spot.get(r.view);
    else if (r.u != null) middle = [r.u, r.v];
    draw();
  };

  // Viser draws no scene that is out of the window: without a graphics card that is most of the work.
  const hideScene = (isHidden) => {
    const canvas = document.querySelector("canvas"), scene = canvas && canvas.closest('[style*="z-index: 0"]');
    if (scene) scene.style.transform = isHidden ? "translateX(-300vw)" : "";
  };

  // --- what a person does ---------------------------------------------------------------------
  const open = () => {
    if (root || !shown()) return;
    root = make("div", "rs-photograph", document.body);
    hideScene(true);
    make("div", "rs-panes", root);
    const bar = make("div", "rs-bar", root);
    make("b", "rs-caption", bar);
    const press = (text, title, act) => {
      const b = make("button", "", bar, text);
      b.title = title; b.onclick = () => { act(); b.blur(); };
      return b;
    };
    LAYERS.forEach((name, k) => {
      press(name, `key ${k + 1}`, () => { layer = name; draw(); }).dataset.layer = name;
    });
    press("blink", "key space: photograph and render in turn", blink);
    press("outlines", "key 5", () => { lines = !lines; draw(); });
    press("three views", "key S: the same spot in three views", three);
    press("fit", "key 0", fit);
    make("span", "rs-zoom", bar);
    make("span", "rs-compared", bar);
    press("close", "key G", close);
    make("div", "rs-legend", root);
    make("div", "rs-note", root);
    make("div", "rs-strip", root);
    const area = root.querySelector(".rs-panes");
    area.addEventListener("wheel", (event) => {
      event.preventDefault();
      scaled(Math.exp(-event.deltaY / 400), event);
    }, { passive: false });
    let from = null;
    area.addEventListener("pointerdown", (event) => {
      from = { x: event.clientX, y: event.clientY, middle, moved: false };
      area.setPointerCapture(event.pointerId);
    });
    area.addEventListener("pointermove", (event) => {
      if (!from || !strip) return;
      const dx = event.clientX - from.x, dy = event.clientY - from.y;
      from.moved = from.moved || Math.hypot(dx, dy) > 3;
      if (!from.moved) return;
      middle = [from.middle[0] - dx / zoom, from.middle[1] - dy / zoom];
      if (isThree) { spot = spot || new Map(); panes.forEach((p) => { p.at = [p.at[0] - event.movementX / zoom, p.at[1] - event.movementY / zoom]; spot.set(p.row.view, p.at); }); }
      place();
    });
    area.addEventListener("pointerup", (event) => {
      if (from && !from.moved && strip) pick(event);
      from = null;
    });
    seen = { state: "", whose: "" }; zoom = 0;
    renew();
  };
  const close = () => { hideScene(false); if (root) root.remove(); root = null; panes = []; window.realsimPlace.tell(null); };
  const fit = () => { zoom = strip ? fitted() : 1; middle = strip ? [strip.width / 2, strip.height / 2] : middle; if (strip) place(); };
  const three = () => { isThree = !isThree; draw(); };
  const blink = () => { layer = layer === "photo" ? "render" : "photo"; draw(); };
  const pixel = (event, p) => {
    const box = p.box.getBoundingClientRect(), c = isThree && spot ? p.at : middle, { left, width, height } = room();
    return [c[0] + (event.clientX - box.x - left - width / 2) / zoom, c[1] + (event.clientY - box.y - height / 2) / zoom];
  };
  const scaled = (factor, event) => {
    if (!strip) return;
    const held = event && !isThree ? pixel(event, panes[0]) : null, before = zoom;
    zoom = Math.min(Math.max(zoom * factor, 0.5 * fitted()), 32);
    if (held) middle = middle.map((m, k) => held[k] + (m - held[k]) * before / zoom);
    place();
  };
  const pick = async (event) => { // this spot is the middle of all views
    const p = panes.find((q) => { const b = q.box.getBoundingClientRect(); return event.clientX >= b.x && event.clientX <= b.right; });
    if (!p) return;
    const [u, v] = pixel(event, p), found = await ask("spot", p.row.view, u.toFixed(2), v.toFixed(2));
    if (!found || !root || !panes.includes(p)) return;
    if (!found.length) return tell("nothing was measured at this pixel, and no model stands there");
    spot = new Map(found.map((f) => [f.view, [f.u, f.v]]));
    tell(`this spot is in ${found.length} views: walk through them with the arrow keys, or press S`);
    middle = spot.get(p.row.view) || middle;
    draw();
  };
  const KEYS = {
    g: close, escape: close, arrowleft: () => go(at - 1), arrowright: () => go(at + 1), " ": blink, s: three,
    0: fit, "+": () => scaled(1.5), "-": () => scaled(1 / 1.5), 5: () => { lines = !lines; draw(); },
    arrowup: () => {}, arrowdown: () => {}, w: () => {}, a: () => {}, d: () => {}, q: () => {}, e: () => {},
  };
  LAYERS.forEach((name, k) => { KEYS[k + 1] = () => { layer = name; draw(); }; });
  addEventListener("keydown", (event) => {
    const inText = event.target instanceof Element && event.target.closest("input, textarea, [contenteditable]");
    if (inText || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    const act = root ? KEYS[key] : key === "g" ? open : null;
    if (!act) return;
    event.preventDefault(); event.stopImmediatePropagation();
    act();
  }, true);
  addEventListener("click", (event) => {
    if (event.target instanceof Element && event.target.closest("[data-realsim-open]")) open();
  });
  addEventListener("resize", () => { if (root && strip) place(); });
  setInterval(() => { // what is looked at, or where it is, may have changed
    if (!shown()) return;
    if (shown().dataset.turn !== turn) { // the server asks for a view
      turn = shown().dataset.turn;
      if (!root) { wanted = shown().dataset.view; open(); }
      else if (strip) go(strip.views.findIndex((r) => String(r.view) === shown().dataset.view));
    } else if (wanted && !root) open();
    if (!root || shown().dataset.state === seen.state) return;
    seen.state = shown().dataset.state;
    if (whose() !== seen.whose) forget(); else draw();
    later();
  }, 120);
})();
