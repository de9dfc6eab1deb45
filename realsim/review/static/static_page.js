"use strict";
// The panel of a static page. It speaks to viser's client in the frame as viser's server would: by
// messages in its queue.
const data = JSON.parse(document.getElementById("data").textContent);
const frame = document.getElementById("viewer");
const shown = { objects: true, cloud: true, cameras: false, table: true, grasps: true };
let chosen = null, least = 0, ownOnly = false, viewer = null;

function send(...messages) {
  if (viewer === null) return;
  viewer.messageQueue.push(...messages);
  viewer.requestRender();
}

function visibility(name, visible) {
  return { type: "SetSceneNodeVisibilityMessage", name, visible, owner: "" };
}

function showAll() {
  const messages = [visibility("/objects", shown.objects), visibility("/cameras", shown.cameras)];
  if (data.cloud) messages.push(visibility("/cloud", shown.cloud));
  if (data.table) messages.push(visibility("/table", shown.table));
  for (const o of data.objects) {
    messages.push(visibility(`/boxes/${o.instance}`, chosen === o.instance));
  }
  for (const [instance, level] of data.grasps) {
    const own = !ownOnly || chosen === null || chosen === instance;
    const good = level >= least || least <= 0;
    messages.push(visibility(`/grasps/${instance}/${level}`, shown.grasps && own && good));
  }
  send(...messages);
}

// World -> three.js: the root's orientation, which holds which way is up.
function turned(v) {
  const state = frame.contentWindow.__viserSceneTree.getState()[""];
  const [w, x, y, z] = state.wxyz;
  const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
  return [
    v[0] + w * t[0] + y * t[2] - z * t[1],
    v[1] + w * t[1] + z * t[0] - x * t[2],
    v[2] + w * t[2] + x * t[1] - y * t[0],
  ];
}

function lookFrom(position, target) {
  if (viewer === null) return;
  viewer.cameraControl.setLookAt(...turned(position), ...turned(target), true);
  viewer.requestRender();
}

// From where one looks already, nearer: the direction is kept.
function lookAt(target, distance) {
  if (viewer === null) return;
  const control = viewer.cameraControl, at = viewer.camera.position.clone(), to = at.clone();
  control.getPosition(at);
  control.getTarget(to);
  const away = at.sub(to).normalize().multiplyScalar(distance);
  const t = turned(target);
  control.setLookAt(t[0] + away.x, t[1] + away.y, t[2] + away.z, ...t, true);
  viewer.requestRender();
}

function choose(instance) {
  chosen = chosen === instance ? null : instance;
  for (const item of document.querySelectorAll(".object")) {
    const is = Number(item.dataset.instance) === chosen;
    item.classList.toggle("chosen", is);
    item.firstElementChild.setAttribute("aria-expanded", String(is));
    if (is) item.scrollIntoView({ block: "nearest" });
  }
  showAll();
  const found = data.objects.find((o) => o.instance === chosen);
  if (found) lookAt(found.middle, Math.max(2.2 * found.size, 0.15));
}

function standIn(view) {
  const camera = data.cameras.find((c) => c.view === view);
  if (camera) lookFrom(camera.position, camera.target);
}

const looks = {
  first: () => lookFrom(data.look.position, data.look.target),
  top: () => lookFrom(data.look.top, data.look.target),
  back: () => lookFrom(data.look.back, data.look.target),
};

for (const button of document.querySelectorAll("[data-look]")) {
  button.addEventListener("click", () => looks[button.dataset.look]());
}
for (const box of document.querySelectorAll("[data-show]")) {
  // A browser that reloads a page keeps what was ticked.
  shown[box.dataset.show] = box.checked;
  box.addEventListener("change", () => { shown[box.dataset.show] = box.checked; showAll(); });
}
for (const item of document.querySelectorAll(".object")) {
  item.firstElementChild.addEventListener("click", () => choose(Number(item.dataset.instance)));
}
for (const button of document.querySelectorAll("[data-view]")) {
  button.addEventListener("click", () => standIn(Number(button.dataset.view)));
}
const slider = document.getElementById("least"), own = document.getElementById("own");
if (slider) {
  const told = () => {
    least = Number(slider.value);
    const word = least > 0 ? `${data.edges[least].toFixed(2)} and more` : "all, tried or not";
    document.getElementById("least-word").textContent = word;
  };
  slider.addEventListener("input", () => { told(); showAll(); });
  told();
}
if (own) {
  ownOnly = own.checked;
  own.addEventListener("change", () => { ownOnly = own.checked; showAll(); });
}

// Clicks in the scene come back as the messages that viser's server would get.
function clicked(message) {
  if (message.type !== "SceneNodeClickMessage") return;
  const [, kind, number] = message.name.split("/");
  if (kind === "cameras") standIn(Number(number));
  else if (kind === "objects" && chosen !== Number(number)) choose(Number(number));
}

// What tells of the browser's graphics stands below, not before the scene.
const BELOW = '.mantine-Notifications-root[data-position^="top"] { inset: auto auto 12px 12px !important; }';

function begin() {
  const inside = frame.contentWindow, test = document.createElement("canvas");
  if (!test.getContext("webgl2") && !test.getContext("webgl")) {
    document.getElementById("wait").textContent = "This browser cannot draw in three dimensions (WebGL is "
      + "off), so the scene is not shown; the list and the photographs are. Switch on hardware "
      + "acceleration in its settings, or use another browser.";
    return;
  }
  const names = inside.__viserSceneTree ? Object.keys(inside.__viserSceneTree.getState()) : [];
  const found = inside.__viserMutable;
  const ready = found && found.cameraControl && data.nodes.every((n) => names.includes(n));
  if (!ready) { setTimeout(begin, 50); return; }
  viewer = found;
  viewer.sendMessage = clicked;
  const style = inside.document.createElement("style");
  style.textContent = BELOW;
  inside.document.head.append(style);
  const bindings = [{ button: "left", modifier: null }];
  const clickable = [...data.objects.map((o) => `/objects/${o.instance}`),
    ...data.cameras.map((c) => `/cameras/${c.view}`)];
  send(...clickable.map((name) => (
    { type: "SetSceneNodeClickBindingsMessage", name, bindings, owner: "" })));
  showAll();
  document.getElementById("wait").remove();
  document.body.dataset.ready = "yes";
}
begin();
