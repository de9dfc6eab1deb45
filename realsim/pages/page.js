"use strict";
document.documentElement.classList.add("js");
const make = (name, words, label) => {
  const it = document.createElement(name);
  if (words) it.textContent = words;
  if (label) it.setAttribute("aria-label", label);
  return it;
};
for (const group of document.querySelectorAll(".views")) {
  const views = [...group.querySelectorAll(":scope > .view")];
  const layers = [...new Set([...group.querySelectorAll("[data-layer]")].map(f => f.dataset.layer))];
  const bar = make("div");
  bar.className = "steps";
  let at = 0, layer = layers[0];
  const back = make("button", "\u2039", "previous view"), on = make("button", "\u203a", "next view");
  const pick = make("select", "", "view");
  views.forEach((v, k) => { const o = make("option", v.dataset.name); o.value = k; pick.append(o); });
  const count = make("span");
  const show = () => {
    views.forEach((v, k) => {
      v.classList.toggle("on", k === at);
      for (const f of v.querySelectorAll("[data-layer]")) f.classList.toggle("on", f.dataset.layer === layer);
    });
    pick.value = at;
    count.textContent = (at + 1) + " / " + views.length;
    for (const b of bar.querySelectorAll("[data-for]")) b.setAttribute("aria-pressed", b.dataset.for === layer);
  };
  const step = by => { at = (at + by + views.length) % views.length; show(); };
  back.onclick = () => step(-1);
  on.onclick = () => step(1);
  pick.onchange = () => { at = +pick.value; show(); };
  if (views.length > 1) bar.append(back, pick, on, count);
  if (layers.length > 1) {
    const choice = make("span");
    choice.className = "choice";
    for (const name of layers) {
      const b = make("button", name);
      b.dataset.for = name;
      b.onclick = () => { layer = name; show(); };
      choice.append(b);
    }
    bar.append(choice);
  }
  group.prepend(bar);
  show();
}
const box = document.querySelector("dialog"), large = box.querySelector("img"), words = box.querySelector("span");
let shown = [], place = 0;
const enlarge = by => {
  place = (place + by + shown.length) % shown.length;
  const from = shown[place].querySelector("img");
  large.src = from.src;
  large.alt = words.textContent = from.alt;
};
for (const sheet of document.querySelectorAll(".sheet")) {
  const all = [...sheet.querySelectorAll("button")];
  all.forEach((b, k) => b.onclick = () => { shown = all; place = k; enlarge(0); box.showModal(); });
}
box.querySelector("[data-close]").onclick = () => box.close();
for (const b of box.querySelectorAll("[data-step]")) b.onclick = () => enlarge(+b.dataset.step);
box.onclick = e => { if (e.target === box) box.close(); };
box.onkeydown = e => {
  if (e.key === "ArrowRight") enlarge(1);
  if (e.key === "ArrowLeft") enlarge(-1);
};
// A printed page shows what is folded away.
addEventListener("beforeprint", () => { for (const d of document.querySelectorAll("details")) d.open = true; });

// A link into a folded stage opens it; what is printed is open.
const unfold = () => {
  const at = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (at) { const stage = at.closest("details"); if (stage) stage.open = true; at.scrollIntoView(); }
};
addEventListener("hashchange", unfold);
addEventListener("beforeprint", () => { for (const d of document.querySelectorAll("details")) d.open = true; });
unfold();
