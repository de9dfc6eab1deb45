// The review's page: the address says what is looked at, so that a link shows a colleague the same.
// The server reads and writes it as an item of the browser's storage that is none: PLACE.
(() => {
  const open = HTMLCanvasElement.prototype.getContext, probe = document.createElement("canvas");
  const drawn = probe.getContext("webgl2") || probe.getContext("webgl");
  const named = drawn && drawn.getExtension("WEBGL_debug_renderer_info");
  const isPlain = named && /swiftshader|llvmpipe|software/i.test(drawn.getParameter(named.UNMASKED_RENDERER_WEBGL));
  if (isPlain) {
    // Smoothed edges, shadows and fading cost a processor as much as the rest of the scene.
    document.documentElement.classList.add("realsim-plain");
    HTMLCanvasElement.prototype.getContext = function (kind, wish) {
      return open.call(this, kind, String(kind).startsWith("webgl") ? { ...wish, antialias: false, preserveDrawingBuffer: false } : wish);
    };
  }
  if (drawn) drawn.getExtension("WEBGL_lose_context")?.loseContext();
  // Viser would light the scene by a photograph until the server's word comes: that one is not read.
  const fetched = window.fetch;
  window.fetch = (what, ...rest) =>
    String(what.url ?? what).startsWith("data:image/jpeg") ? new Promise(() => {}) : fetched(what, ...rest);
  // Keys and clicks are handed on one after the other, each when the server has done the one before
  // (hands.py). What judges or moves an object is left out where another one is shown by then.
  const ACTS = /^[hnpyxzmvbtcfjlkiou]$/i, LOOKS = /^[hnpcf]$/i; // keys.py
  const TYPING_MS = 300, PATIENCE_MS = 10000;
  const waiting = [], stands = () => document.querySelector("[data-realsim-hands]");
  let awaited = null, until = 0, isSure = false, typed = 0, isHandingOn = false, note = null, down = [0, 0];
  const whose = () => (window.realsimShown ? window.realsimShown() : "");
  const say = (text) => {
    if (note) note.remove();
    note = document.createElement("p");
    note.className = "realsim-held";
    note.textContent = text;
    document.body.append(note);
    setTimeout((old) => old.remove(), 5000, note);
  };
  const received = () => stands().dataset.realsimHands;
  // A click into the scene may choose nothing: then no answer comes.
  const wait = (ms) => { [awaited, until, isSure] = [received(), Date.now() + ms, ms === PATIENCE_MS]; };
  const handOn = () => {
    if (!stands() || stands().dataset.atWork !== "0" || Date.now() - typed < TYPING_MS) return;
    if (whose().includes(" ")) return;
    if (awaited === received()) {
      if (Date.now() < until) return;
      if (isSure && waiting.splice(0).length)
        say("The server has not answered for 10 s: what was pressed since is left out. Load the page anew.");
      if (isSure) return;
    }
    const next = waiting.shift();
    if (!next) return;
    if (next.whose !== null && next.whose !== whose() && !next.looks)
      return say(`${next.name} was pressed while another object was shown: nothing is done. Press again.`);
    isHandingOn = true;
    next.act();
    isHandingOn = false;
  };
  const hold = (item) => {
    if (waiting.push(item) > 20) say(`Too much was pressed at once: ${waiting.pop().name} is left out.`);
    handOn();
  };
  addEventListener("keydown", (event) => {
    const inText = event.target instanceof Element && event.target.closest("input, textarea");
    if (isHandingOn || inText || event.ctrlKey || event.metaKey || event.altKey) return;
    if (stands() && !ACTS.test(event.key)) return;
    event.stopImmediatePropagation();
    if (event.repeat && waiting.length) return; // what is held goes on as fast as it is done
    strike(event.key, event.code, event.shiftKey);
  }, true);
  const strike = (key, code = "Key" + key.toUpperCase(), shiftKey = false) => {
    const act = () => {
      if (ACTS.test(key)) wait(PATIENCE_MS);
      document.body.dispatchEvent(new KeyboardEvent("keydown", { key, code, shiftKey, bubbles: true, cancelable: true }));
    };
    hold({ name: key.toUpperCase(), looks: LOOKS.test(key) || !ACTS.test(key), whose: stands() ? whose() : null, act });
  };
  setInterval(handOn, 25);
  addEventListener("input", () => { typed = Date.now(); }, true); // viser sends a text some time after it
  addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; }, true);
  addEventListener("click", (event) => {
    if (isHandingOn || !stands() || !(event.target instanceof Element)) return;
    const isDrag = Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 3;
    // The scene: what a click chooses there has to be shown before a key counts.
    if (event.target.closest("canvas") && !isDrag) return wait(1000);
    const step = event.target.closest("[data-realsim-key]");
    if (step) return strike(step.dataset.realsimKey);
    const button = event.target.closest("button.mantine-Button-root");
    if (!button) return;
    event.stopImmediatePropagation();
    event.preventDefault();
    if (event.detail) button.blur(); // pressed by a pointer, it takes no key that comes later
    const text = button.textContent, name = button.innerText.trim().split("\n")[0];
    const act = () => {
      if (!button.isConnected || button.disabled || button.textContent !== text)
        return say(`${name} was pressed while something else was being done: nothing is done. Press again.`);
      wait(PATIENCE_MS);
      button.dispatchEvent(new MouseEvent("click", { bubbles: true, cancelable: true }));
    };
    const panel = button.closest("[data-dock-window], .mantine-Paper-root");
    hold({ name, looks: !!(panel && panel.querySelector(".realsim-progress")), whose: whose(), act });
  }, true);
  const PLACE = "realsim place", read = Storage.prototype.getItem, write = Storage.prototype.setItem;
  const is = (key) => String(key).endsWith(PLACE);
  // Viser takes its server's address from the page's: at that moment there must be no fragment.
  let place = location.hash.slice(1);
  // As coarse as viser itself would draw after some seconds of being slow.
  history.replaceState(null, "", location.pathname + (isPlain ? "?fixedDpr=0.75" : ""));
  const said = () => new URLSearchParams(place);
  const tell = (fields) => {
    place = fields.toString();
    history.replaceState(null, "", location.pathname + "#" + place);
  };
  const name = (draft) => `${draft.instance} ${draft.scene}`;
  Storage.prototype.getItem = function (key) {
    return is(key) ? said().toString() : read.call(this, key);
  };
  Storage.prototype.setItem = function (key, value) {
    if (String(key).endsWith("realsim corrections")) { // of all tabs; one tells what it changed
      const told = JSON.parse(value), changed = [...told.set, ...told.gone].map(name);
      const others = JSON.parse(read.call(this, key) || "[]").filter((d) => !changed.includes(name(d)));
      value = JSON.stringify([...others, ...told.set]);
    }
    if (!is(key)) return write.call(this, key, value);
    const fields = new URLSearchParams(value);
    for (const own of ["tab", "photo"]) if (said().get(own)) fields.set(own, said().get(own));
    tell(fields);
    const words = [fields.get("object"), fields.get("scene"), "realsim review"];
    document.title = words.filter((word) => word).join(" \u00b7 ");
  };
  window.realsimPlace = { // of the photographs
    photo: () => said().get("photo"),
    tell: (view) => {
      const fields = said();
      if (view === null) fields.delete("photo"); else fields.set("photo", view);
      tell(fields);
    },
  };
  addEventListener("hashchange", () => location.reload());
  // The chosen tab is the browser's own.
  const tabs = () => [...document.querySelectorAll("[role=tab]")];
  addEventListener("click", (event) => {
    const tab = event.target instanceof Element && event.target.closest("[role=tab]");
    if (!tab) return;
    const fields = said();
    fields.set("tab", tab.textContent.trim());
    tell(fields);
  });
  const wanted = said().get("tab");
  // A tab that is there may not listen yet: it is pressed until it is chosen.
  let tries = 0;
  const press = setInterval(() => {
    const tab = tabs().find((t) => t.textContent.trim() === wanted);
    if (!wanted || (tab && tab.ariaSelected === "true") || ++tries > 300) return clearInterval(press);
    if (!tab) return;
    const at = tab.getBoundingClientRect();
    const where = { bubbles: true, clientX: at.x + at.width / 2, clientY: at.y + at.height / 2, button: 0 };
    for (const kind of ["pointerdown", "pointerup", "click"])
      tab.dispatchEvent(new PointerEvent(kind, { ...where, pointerId: 1, isPrimary: true }));
  }, 200);
  addEventListener("DOMContentLoaded", () => {
    if (drawn) return;
    const note = document.createElement("p");
    note.className = "realsim-no-webgl";
    note.textContent = "This browser cannot draw in three dimensions (WebGL is off), so the scene stays "
      + "empty. Switch on hardware acceleration in its settings, or use another browser.";
    document.body.append(note);
  });
})();
