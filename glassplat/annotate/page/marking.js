// The document of marks: what can be done to it, and undone. It knows nothing of the page.

const MOST_UNDONE = 200;

export class Marking {
  constructor(document, changed) {
    this.document = document;
    this.changed = changed;
    this.undone = [];
    this.done = [];
    this.active = document.panes.length ? document.panes[0].label : null;
  }

  get pane() {
    return this.document.panes.find((pane) => pane.label === this.active) || null;
  }

  // Changes the document as one step that can be taken back; `gesture` joins steps of one drag.
  change(work, gesture = null) {
    const before = JSON.stringify(this.document);
    work(this.document);
    if (JSON.stringify(this.document) === before) return;
    if (gesture === null || this.gesture !== gesture) {
      this.done.push(before);
      this.done.splice(0, this.done.length - MOST_UNDONE);
    }
    this.gesture = gesture;
    this.undone = [];
    this.changed();
  }

  // A document that the server has put together of this one and another. No step leads back to before that: it would
  // take away what another page has saved.
  takeOver(together, renamed) {
    [this.document, this.done, this.undone, this.gesture] = [together, [], [], null];
    this.active = renamed[this.active] || this.active; // Who goes on marking marks the same pane.
    if (!this.pane) this.active = this.document.panes.length ? this.document.panes[0].label : null;
  }

  undo() { this.#travel(this.done, this.undone); }

  redo() { this.#travel(this.undone, this.done); }

  #travel(from, to) {
    if (!from.length) return;
    to.push(JSON.stringify(this.document));
    this.document = JSON.parse(from.pop());
    this.gesture = null;
    if (!this.pane) this.active = this.document.panes.length ? this.document.panes[0].label : null;
    this.changed();
  }

  // Returns whether there is room for one more.
  addPane() {
    const used = this.document.panes.map((pane) => pane.label);
    let label = 1;
    while (used.includes(label)) label += 1;
    if (label > 64) return false;
    this.change((document) => {
      document.panes.push({ label, material: "glass", shape: "rectangle", corners: [{}, {}, {}, {}], edges: [{}, {}, {}, {}], strokes: {} });
      this.active = label;
    });
    return true;
  }

  removePane(label) {
    this.change((document) => {
      document.panes = document.panes.filter((pane) => pane.label !== label);
      if (this.active === label) this.active = document.panes.length ? document.panes[0].label : null;
    });
  }

  set(label, key, value) {
    this.change((document) => { document.panes.find((pane) => pane.label === label)[key] = value; });
  }

  // The corner that the next click in a view marks: the first that has no mark there and is not skipped; a polygon
  // may grow.
  nextCorner(view, skipped = new Set()) {
    const pane = this.pane;
    if (!pane) return null;
    const free = pane.corners.findIndex((places, number) => !(view in places) && !skipped.has(number));
    if (free >= 0) return free;
    return pane.shape === "polygon" && pane.corners.every((places) => Object.keys(places).length <= 1) ? pane.corners.length : null;
  }

  setCorner(view, number, place, gesture = null) {
    this.change(() => {
      const pane = this.pane;
      while (pane.corners.length <= number) { pane.corners.push({}); pane.edges.push({}); }
      pane.corners[number][view] = rounded(place);
    }, gesture);
  }

  setEdge(view, number, ends) {
    this.change(() => { this.pane.edges[number][view] = ends.map(rounded); });
  }

  nextEdge(view, skipped = new Set()) {
    if (!this.pane) return null;
    const free = this.pane.edges.findIndex((places, number) => !(view in places) && !skipped.has(number));
    return free >= 0 ? free : null;
  }

  addStrokes(view, made, label = this.active) {
    this.change((document) => {
      const strokes = document.panes.find((pane) => pane.label === label)?.strokes;
      if (!strokes) return; // The pane was removed meanwhile.
      (strokes[view] = strokes[view] || []).push(...made.map((stroke) => ({ ...stroke, points: stroke.points.map(rounded) })));
    });
  }

  // Removes what lies within `reach` of a place: a corner, an edge, or the topmost stroke over it.
  removeAt(view, place, reach, inside) {
    this.change(() => {
      const pane = this.pane;
      if (!pane) return;
      const corner = pane.corners.findIndex((places) => view in places && distance(places[view], place) < reach);
      if (corner >= 0) { delete pane.corners[corner][view]; shorten(pane); return; }
      const edge = pane.edges.findIndex((places) => view in places && fromSegment(place, ...places[view]) < reach);
      if (edge >= 0) { delete pane.edges[edge][view]; shorten(pane); return; }
      const strokes = pane.strokes[view] || [];
      for (let number = strokes.length - 1; number >= 0; number -= 1) {
        if (inside(strokes[number], place)) {
          strokes.splice(number, 1);
          if (!strokes.length) delete pane.strokes[view];
          return;
        }
      }
    });
  }

  viewsMarked() {
    const names = new Set();
    for (const pane of this.document.panes) {
      for (const places of [...pane.corners, ...pane.edges]) Object.keys(places).forEach((name) => names.add(name));
      Object.keys(pane.strokes).forEach((name) => names.add(name));
    }
    return names;
  }
}

export function distance(one, other) {
  return Math.hypot(one[0] - other[0], one[1] - other[1]);
}

export function fromSegment(place, one, other) {
  const along = [other[0] - one[0], other[1] - one[1]];
  const length = along[0] ** 2 + along[1] ** 2 || 1;
  const share = ((place[0] - one[0]) * along[0] + (place[1] - one[1]) * along[1]) / length;
  const inside = Math.min(1, Math.max(0, share));
  return distance(place, [one[0] + inside * along[0], one[1] + inside * along[1]]);
}

// Takes the last corners off a polygon where neither they nor the edges there have a mark.
function shorten(pane) {
  const isBare = (places) => !Object.keys(places).length;
  while (pane.corners.length > 4 && isBare(pane.corners.at(-1)) && pane.edges.slice(pane.corners.length - 2).every(isBare)) {
    pane.corners.pop();
    pane.edges.splice(pane.corners.length);
  }
}

function rounded(place) {
  return place.map((value) => Math.round(value * 100) / 100);
}
