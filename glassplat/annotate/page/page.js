// The page: photographs, panes, tools and keys; the server is told of every change, and says what follows.

import { Drawing, colorOf } from "/drawing.js";
import { Marking, distance } from "/marking.js";

const element = (id) => document.getElementById(id);
const GONE = "the command has ended; start it again, open the address that it prints in a new tab, and go on here";
const REACH = 11; // Pixels of the screen around a corner that belong to it.

let capture, marking, drawing;
let current = 0, tool = "corner", radius = 20, pending = null, drag = null, pointer = null, gestures = 0;
let skipped = { corner: new Set(), edge: new Set() }; // In this photograph: what is not to be seen in it.
let answers = {}, sending = false, waiting = false, saveTimer = null, spaceHeld = false;
let revision = 0; // Counts changes.
let shownPane = null; // The pane that a line being drawn, and what is skipped, belong to.
const images = new Map();

async function ask(path, body) {
  const options = body === undefined ? {} : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  const response = await fetch(path, options).catch(() => { throw new Error(GONE); });
  const answer = await response.json();
  if (!response.ok) throw Object.assign(new Error(answer.error || response.statusText), { answer });
  return answer;
}

function tell(text, isBad = false) {
  if (document.body.dataset.state === "closed") return; // Its place is gone.
  element("status").textContent = text;
  element("status").className = isBad ? "bad" : "";
}

// Sends the document a moment after the last change; one request at a time.
function changed() {
  revision += 1;
  document.body.dataset.state = "changed";
  clearTimeout(saveTimer);
  saveTimer = setTimeout(send, 120);
  refresh();
}

async function send() {
  if (sending) { waiting = true; return; }
  sending = true;
  const sent = revision;
  try {
    const answer = await ask("/document", { document: marking.document, version: capture.version });
    capture.version = answer.version;
    answers = Object.fromEntries(answer.panes.map((pane) => [pane.label, pane]));
    // What changed while the answer was on its way is not saved yet, whether or not its own sending has begun.
    if (revision === sent) {
      document.body.dataset.state = "saved";
      tell("saved");
    }
  } catch (error) {
    if (error.answer && error.answer.document && revision === sent) {
      takeOver(error.answer, error.message);
    } else if (error.answer && error.answer.document) {
      waiting = true; // The next sending is refused too, with what changed in the meantime.
    } else {
      document.body.dataset.state = "failed";
      tell(`not saved: ${error.message}`, true);
    }
  }
  sending = false;
  if (waiting) { waiting = false; send(); }
  refresh();
}

// Another page has saved since: the server has put both together, which is shown here and saved next.
function takeOver(answer, message) {
  capture.version = answer.version;
  pending = drag = null;
  element("elsewhere").textContent = message;
  marking.takeOver(answer.document, answer.renamed);
  changed();
}

function refresh() {
  const isOther = shownPane !== marking.active;
  if (isOther) { shownPane = marking.active; pending = drag = null; unskip(); }
  drawViews();
  drawPanes();
  if (isOther) element("panes").querySelector(".active")?.scrollIntoView({ block: "nearest" });
  element("undo").disabled = !marking.done.length;
  element("redo").disabled = !marking.undone.length;
  document.querySelectorAll("[data-tool]").forEach((button) => button.setAttribute("aria-pressed", button.dataset.tool === tool));
  element("hint").textContent = hint();
  draw();
}

function hint() {
  if (!marking.pane) return "add a pane first";
  const how = document.querySelector(`[data-tool=${tool}]`).title.slice(3);
  if (tool !== "corner" && tool !== "edge") return how;
  const number = upcoming();
  if (number === null) return `all ${tool}s are marked or skipped here; drag corners, or go to another photograph`;
  const which = tool === "corner" ? `corner ${number + 1}` : `edge from corner ${number + 1} to ${(number + 1) % marking.pane.corners.length + 1}`;
  return `${which}: ${how}; N skips it`;
}

// The corner or edge that comes next in this photograph.
function upcoming() {
  const name = view().name;
  return tool === "edge" ? marking.nextEdge(name, skipped.edge) : marking.nextCorner(name, skipped.corner);
}

function skip() {
  if (tool !== "corner" && tool !== "edge") return;
  const number = upcoming();
  if (number === null) skipped[tool].clear(); else skipped[tool].add(number);
  refresh();
}

function unskip() { skipped = { corner: new Set(), edge: new Set() }; }

const view = () => capture.views[current];

function draw() {
  drawing.upcoming = tool === "corner" && marking.pane ? upcoming() : null;
  drawing.draw(marking.document.panes, answers, marking.active, pending);
}

function suggested() {
  const answer = answers[marking.active];
  return answer ? answer.next : [];
}

function drawViews() {
  const marked = marking.viewsMarked();
  const next = suggested().map((one) => one.view);
  capture.views.forEach((one, number) => {
    const button = element("views").children[number];
    const star = next.indexOf(number) === 0 ? "★" : next.includes(number) ? "☆" : "";
    button.className = [marked.has(one.name) ? "marked" : "", star ? "suggested" : ""].join(" ");
    button.setAttribute("aria-current", number === current);
    button.querySelector("b").textContent = star || (marked.has(one.name) ? "✓" : "");
  });
}

function make(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function choice(label, key, values) {
  const select = make("select", { title: key });
  select.append(...values.map((value) => make("option", { textContent: value })));
  select.addEventListener("change", () => marking.set(label, key, select.value));
  return select;
}

function makeCard(label) {
  const swatch = make("i");
  swatch.style.background = colorOf(label);
  const remove = make("button", { textContent: "×", title: "remove this pane" });
  remove.addEventListener("click", (event) => { event.stopPropagation(); marking.removePane(label); });
  const card = make("div", { className: "pane" },
    make("h2", {}, swatch, `pane ${label}`, remove), choice(label, "material", ["glass", "mirror", "screen"]), " ", choice(label, "shape", ["rectangle", "polygon"]), make("div"));
  card.addEventListener("click", () => { if (marking.active !== label) { marking.active = label; refresh(); } });
  return card;
}

// A card stays as long as its pane: an open menu and the focus of keys outlast a click and the answers of the server.
function drawPanes() {
  const panes = marking.document.panes, labels = panes.map((pane) => pane.label).join(), list = element("panes");
  if (list.dataset.labels !== labels) list.replaceChildren(...panes.map((pane) => makeCard(pane.label)));
  list.dataset.labels = labels;
  panes.forEach((pane, number) => {
    const card = list.children[number];
    card.classList.toggle("active", pane.label === marking.active);
    for (const select of card.querySelectorAll("select")) select.value = pane[select.title];
    card.lastChild.replaceChildren(...judgement(answers[pane.label]).map(([textContent, className]) => make("p", { textContent, className })));
  });
}

const GOOD = 0.5, SURE = 2; // degrees
const degrees = (angle) => `${angle.toFixed(angle < 1 ? 2 : 1)}°`;
const counted = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

function judgement(answer) {
  if (!answer) return [];
  if (!answer.solved) return [[answer.message, "poor"]];
  const lines = [[`marks fit to ${answer.error.toFixed(1)} pixels; the plane is uncertain by ${degrees(answer.uncertainty)}`, answer.uncertainty < GOOD ? "good" : answer.uncertainty < SURE ? "" : "poor"]];
  if (answer.message) lines.push([answer.message, "poor"]);
  const best = answer.next[0];
  if (best && answer.uncertainty > 0.3) lines.push([`marking ${capture.views[best.view].name} would make it ${degrees(best.uncertainty)}`, ""]);
  return lines;
}

async function show(number) {
  current = (number + capture.views.length) % capture.views.length;
  pending = drag = null;
  unskip();
  drawing.show({ ...view(), number: current }, images.get(current) || null);
  refresh();
  element("views").children[current].scrollIntoView({ block: "nearest" });
  document.body.dataset.view = "loading";
  await load(current);
  drawing.image = images.get(current); // Of the photograph that is shown by now.
  document.body.dataset.view = images.has(current) ? String(current) : "failed";
  draw();
  load((current + 1) % capture.views.length);
}

async function load(number) {
  if (images.has(number)) return images.get(number);
  const image = new Image();
  image.src = `/photo/${number}`;
  try {
    await image.decode();
  } catch {
    tell(`photograph ${capture.views[number].name} cannot be shown`, true);
    return null;
  }
  images.set(number, image);
  if (images.size > 40) images.delete(images.keys().next().value);
  return image;
}

const spot = (event) => { const box = drawing.canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };

function pressed(event) {
  drawing.canvas.focus();
  drawing.canvas.setPointerCapture(event.pointerId);
  const at = spot(event), place = drawing.toView(at);
  if (event.button !== 0 || spaceHeld) { drag = { kind: "move", at }; return; }
  if (!marking.pane) return;
  if (tool === "corner") pressCorner(place);
  else if (tool === "edge") { pending = { kind: "edge", points: [place, place] }; drag = { kind: "edge" }; }
  else if (tool === "polygon" || tool === "grab") pressPolygon(place);
  else { pending = { kind: "brush", effect: tool === "brush" ? "cut" : "keep", radius: Math.min(10000, Math.max(0.1, radius / drawing.scale)), points: [place] }; drag = { kind: "brush" }; }
  draw();
}

function pressCorner(place) {
  const reach = REACH / drawing.scale, name = view().name;
  let number = drawing.cornerAt(marking.pane, answers[marking.active], place, reach);
  if (number < 0) number = marking.nextCorner(name, skipped.corner);
  if (number === null) return;
  gestures += 1;
  // A marked corner keeps its distance from the pointer. One that only the fit knows is marked where it is pressed.
  const at = marking.pane.corners[number]?.[name] || place;
  drag = { kind: "corner", number, gesture: `drag ${gestures}`, by: [at[0] - place[0], at[1] - place[1]] };
  if (at === place) marking.setCorner(name, number, place, drag.gesture);
}

function pressPolygon(place) {
  if (!pending) pending = { kind: "polygon", points: [place, place] };
  else pending.points.splice(-1, 1, place, place);
}

function moved(event) {
  const at = spot(event), place = drawing.toView(at);
  pointer = at;
  if (!drag) {
    if (pending && pending.kind === "polygon") { pending.points[pending.points.length - 1] = place; draw(); }
    return;
  }
  if (drag.kind === "move") { drawing.move([at[0] - drag.at[0], at[1] - drag.at[1]]); drag.at = at; }
  else if (drag.kind === "corner") marking.setCorner(view().name, drag.number, [place[0] + drag.by[0], place[1] + drag.by[1]], drag.gesture);
  else if (drag.kind === "edge") pending.points[1] = place;
  else if (distance(pending.points[pending.points.length - 1], place) * drawing.scale > 3) pending.points.push(place);
  draw();
}

function released() {
  if (drag && drag.kind === "edge" && distance(...pending.points) * drawing.scale > 10) {
    const number = marking.nextEdge(view().name, skipped.edge);
    if (number !== null) marking.setEdge(view().name, number, pending.points);
  }
  if (drag && drag.kind === "brush") marking.addStrokes(view().name, [pending]);
  if (!pending || pending.kind !== "polygon") pending = null;
  drag = null;
  draw();
}

function closePolygon() {
  if (!pending || pending.kind !== "polygon") return;
  const points = pending.points.slice(0, -1).filter((point, index, all) => !index || distance(point, all[index - 1]) * drawing.scale > 2);
  pending = null;
  if (points.length > 2) { if (tool === "grab") grab(points); else marking.addStrokes(view().name, [cutting(points)]); }
  draw();
}

const cutting = (points) => ({ kind: "polygon", effect: "cut", radius: 1, points });

// The server looks for the thing within a rough outline; its pieces are cut out as one step. The pane and the photograph
// are those of the click, whatever is looked at when the answer comes.
async function grab(points) {
  const label = marking.active, name = view().name;
  document.body.dataset.grab = "looking";
  tell("looking for the outline ...");
  try {
    const { outlines } = await ask("/grab", { view: current, points });
    marking.addStrokes(name, outlines.map(cutting), label);
    document.body.dataset.grab = "done";
  } catch (error) {
    document.body.dataset.grab = "failed";
    tell(error.message, true);
  }
}

function giveUp() { pending = drag = null; draw(); }

// A line that is being drawn goes first.
function undo() {
  const isDrawing = pending !== null;
  giveUp();
  if (!isDrawing) marking.undo();
}

function choose(name) { tool = name; pending = drag = null; refresh(); }

function nextPane() {
  const labels = marking.document.panes.map((pane) => pane.label);
  if (!labels.length) return;
  marking.active = labels[(labels.indexOf(marking.active) + 1) % labels.length];
  refresh();
}

const KEYS = {
  ArrowLeft: () => show(current - 1),
  ArrowRight: () => show(current + 1),
  s: () => { const next = suggested()[0]; if (next) show(next.view); },
  a: () => marking.addPane() || tell("there can be 64 panes at most", true),
  n: skip,
  0: () => { drawing.fit(); draw(); },
  1: () => choose("corner"),
  2: () => choose("edge"),
  3: () => choose("polygon"),
  4: () => choose("brush"),
  5: () => choose("grab"),
  6: () => choose("restore"),
  "[": () => { radius = Math.max(2, radius / 1.25); tell(`brush of ${Math.round(radius)} pixels`); },
  "]": () => { radius = Math.min(300, radius * 1.25); tell(`brush of ${Math.round(radius)} pixels`); },
  " ": () => { spaceHeld = true; },
  Enter: closePolygon,
  Escape: giveUp,
  Tab: nextPane,
  Delete: () => { if (pointer) marking.removeAt(view().name, drawing.toView(pointer), REACH / drawing.scale, (stroke, place) => drawing.covers(stroke, place)); },
};
KEYS.Backspace = KEYS.Delete;

function keyed(event) {
  if (event.target.closest("select, summary")) return;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
    event.preventDefault();
    event.shiftKey ? marking.redo() : undo();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || (event.shiftKey && event.key === "Tab")) return;
  const act = KEYS[event.key] || KEYS[event.key.toLowerCase()];
  if (!act || (event.target.closest("button") && ["Enter", "Tab", " "].includes(event.key))) return;
  event.preventDefault();
  act();
}

async function write() {
  tell("writing masks and planes ...");
  document.body.dataset.written = "";
  try {
    await settled();
    const { masks, planes, told } = await ask("/results", {});
    const uncertain = planes.filter((plane) => plane.uncertainty >= SURE).map((plane) => `pane ${plane.label} (${degrees(plane.uncertainty)})`);
    const warning = uncertain.length ? `; still uncertain, mark more: ${uncertain.join(", ")}` : "";
    tell(told ?? `written: ${counted(masks.length, "mask")}, ${counted(planes.length, "plane")}${warning}`, uncertain.length > 0);
    document.body.dataset.written = `${masks.length} ${planes.length}`;
  } catch (error) {
    tell(error.message, true);
    document.body.dataset.written = "failed";
  }
}

// Resolves when the server knows everything; an error if it refuses that once more.
async function settled() {
  if (document.body.dataset.state === "failed") await send();
  while (document.body.dataset.state === "changed" || document.body.dataset.grab === "looking" || sending) await new Promise((next) => setTimeout(next, 50));
  if (document.body.dataset.state === "failed") throw new Error(element("status").textContent);
}

const resized = new ResizeObserver(() => { drawing.resized(); draw(); });

async function close() {
  let warning;
  try {
    await settled();
    ({ warning } = await ask("/close", {}));
  } catch (error) {
    tell(error.message, true);
    return;
  }
  resized.disconnect();
  window.removeEventListener("keydown", keyed);
  document.body.replaceChildren(make("p", { textContent: `Saved. The command has ended; this page can be closed.${warning && ` But ${warning}.`}` }));
  document.body.dataset.state = "closed";
}

function listen() {
  const canvas = drawing.canvas;
  canvas.addEventListener("pointerdown", pressed);
  canvas.addEventListener("pointermove", moved);
  canvas.addEventListener("pointerup", released);
  canvas.addEventListener("pointercancel", released);
  canvas.addEventListener("dblclick", closePolygon);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); drawing.zoom(spot(event), Math.exp(-event.deltaY / 400)); draw(); }, { passive: false });
  window.addEventListener("keydown", keyed);
  window.addEventListener("keyup", (event) => { if (event.key === " ") spaceHeld = false; });
  window.addEventListener("blur", () => { spaceHeld = false; });
  window.addEventListener("beforeunload", (event) => { if (["changed", "failed"].includes(document.body.dataset.state)) event.preventDefault(); });
  resized.observe(canvas);
  // Space and Enter are the photograph's again after a click; a button that a key has pressed keeps the focus.
  window.addEventListener("click", (event) => { if (event.detail) event.target.closest("button")?.blur(); });
  document.querySelectorAll("[data-tool]").forEach((button) => button.addEventListener("click", () => choose(button.dataset.tool)));
  for (const [id, act] of [["undo", undo], ["redo", () => marking.redo()], ["add", KEYS.a], ["write", write], ["close", close]]) {
    element(id).addEventListener("click", act);
  }
}

async function begin() {
  capture = await ask("/capture");
  document.title = `${capture.name}: mark panes`;
  element("capture-name").textContent = capture.name;
  element("views").replaceChildren(...capture.views.map((one, number) => {
    const image = make("img", { src: `/thumbnail/${number}`, loading: "lazy", alt: "" });
    const button = make("button", { title: one.name }, image, make("span", { textContent: one.name }), make("b"));
    button.addEventListener("click", () => show(number));
    return button;
  }));
  marking = new Marking(capture.document, changed);
  drawing = new Drawing(element("canvas"));
  listen();
  if (!marking.document.panes.length) marking.addPane(); else send();
  await show(capture.first);
  document.body.dataset.ready = "yes";
}

begin().catch((error) => tell(error.message, true));
