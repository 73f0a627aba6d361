// One photograph on the canvas, with everything that is known of the panes in it.

import { distance, fromSegment } from "/marking.js";

export const COLORS = ["#53a6ff", "#ff8a5c", "#58d68d", "#d58cff", "#ffd84d", "#5ce1e6", "#ff6fa3", "#b5e853"];
export const colorOf = (label) => COLORS[label - 1] || `hsl(${label * 137.5} 85% 68%)`;
const ROOM = 0.25; // Beside the photograph, in its sizes: corners may lie there.

export class Drawing {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.image = null;
    this.view = null;
    this.scale = 1;
    this.shift = [0, 0];
    this.size = [0, 0]; // Of the canvas in the window.
    this.isWhole = true; // Until it is zoomed or moved.
    this.upcoming = null; // The corner that the next click marks: where it may lie is drawn stronger.
    this.layer = document.createElement("canvas");
  }

  // Shows another view, whole.
  show(view, image) {
    this.view = view;
    this.image = image;
    this.fit();
  }

  fit() {
    const box = this.canvas.getBoundingClientRect();
    const room = 1 + 2 * ROOM;
    this.scale = Math.min(box.width / (this.view.width * room), box.height / (this.view.height * room));
    this.shift = [(box.width - this.view.width * this.scale) / 2, (box.height - this.view.height * this.scale) / 2];
    this.isWhole = true;
  }

  // What was zoomed or moved keeps its scale, and its middle in the middle.
  resized() {
    const { width, height } = this.canvas.getBoundingClientRect();
    if (this.isWhole) this.fit(); else this.move([(width - this.size[0]) / 2, (height - this.size[1]) / 2]);
    this.size = [width, height];
  }

  toView(place) { return [(place[0] - this.shift[0]) / this.scale, (place[1] - this.shift[1]) / this.scale]; }

  toCanvas(place) { return [place[0] * this.scale + this.shift[0], place[1] * this.scale + this.shift[1]]; }

  zoom(place, factor) {
    const before = this.toView(place);
    this.scale = Math.min(40, Math.max(0.02, this.scale * factor));
    const after = this.toCanvas(before);
    this.move([place[0] - after[0], place[1] - after[1]]);
  }

  move(way) {
    this.shift = [this.shift[0] + way[0], this.shift[1] + way[1]];
    this.isWhole = false;
  }

  draw(panes, answers, active, pending) {
    const { canvas, context } = this;
    const box = canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(box.width * ratio);
    canvas.height = Math.round(box.height * ratio);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (!this.view) return;
    const [x, y] = this.shift;
    if (this.image) context.drawImage(this.image, x, y, this.view.width * this.scale, this.view.height * this.scale);
    for (const pane of panes) this.#pane(pane, answers[pane.label], pane.label === active);
    if (pending) this.#pending(pending, colorOf(active));
  }

  #pane(pane, answer, isActive) {
    const color = colorOf(pane.label);
    const { name, number } = this.view;
    if (answer && answer.solved) this.#region(pane, answer.outlines[number], color, isActive);
    this.context.lineWidth = isActive ? 2 : 1;
    if (!isActive) return;
    pane.edges.forEach((places) => { if (name in places) this.#line(places[name], color, []); });
    pane.corners.forEach((places, corner) => {
      const line = answer?.lines?.[corner]?.[number];
      if (line && !(name in places)) this.#guide(line, corner, color);
    });
    if (answer && answer.solved) answer.corners[number].forEach((place, corner) => {
      if (place && !(pane.corners[corner] && name in pane.corners[corner])) this.#corner(place, corner, color, false);
    });
    pane.corners.forEach((places, corner) => { if (name in places) this.#corner(places[name], corner, color, true); });
    if (!answer || !answer.solved) {
      const marked = pane.corners.filter((places) => name in places).map((places) => places[name]);
      if (marked.length > 1) this.#line(marked.length === pane.corners.length ? [...marked, marked[0]] : marked, color, []);
    }
  }

  #region(pane, outline, color, isActive) {
    if (!outline.length) return;
    const shape = this.#path(outline, true);
    const strokes = pane.strokes[this.view.name] || [];
    this.context.save();
    this.context.globalAlpha = isActive ? 0.35 : 0.2;
    this.context.fillStyle = color;
    if (strokes.length) this.#withStrokes(shape, strokes, color);
    else this.context.fill(shape);
    this.context.restore();
    this.context.strokeStyle = color;
    this.context.lineWidth = isActive ? 2 : 1;
    this.context.setLineDash([]);
    this.context.stroke(shape);
  }

  // The pane without what is cut out of it, drawn on a layer of its own so that cuts do not cut the photograph.
  #withStrokes(shape, strokes, color) {
    const layer = this.layer;
    layer.width = this.canvas.width;
    layer.height = this.canvas.height;
    const pencil = layer.getContext("2d");
    pencil.setTransform(this.context.getTransform());
    pencil.fillStyle = color;
    pencil.fill(shape);
    for (const stroke of strokes) {
      pencil.globalCompositeOperation = stroke.effect === "cut" ? "destination-out" : "source-over";
      if (stroke.effect === "keep") { pencil.save(); pencil.clip(shape); }
      this.#stroke(pencil, stroke);
      if (stroke.effect === "keep") pencil.restore();
      pencil.globalCompositeOperation = "source-over";
    }
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    this.context.drawImage(layer, 0, 0);
  }

  #stroke(pencil, stroke) {
    if (stroke.kind === "polygon") { pencil.fill(this.#path(stroke.points, true)); return; }
    pencil.lineCap = pencil.lineJoin = "round";
    pencil.lineWidth = 2 * stroke.radius * this.scale;
    pencil.strokeStyle = pencil.fillStyle;
    const points = stroke.points.length > 1 ? stroke.points : [stroke.points[0], stroke.points[0]];
    pencil.stroke(this.#path(points, false));
  }

  #path(places, closed) {
    const path = new Path2D();
    places.forEach((place, index) => path[index ? "lineTo" : "moveTo"](...this.toCanvas(place)));
    if (closed) path.closePath();
    return path;
  }

  #line(places, color, dash) {
    this.context.strokeStyle = color;
    this.context.setLineDash(dash);
    this.context.stroke(this.#path(places, false));
    this.context.setLineDash([]);
  }

  #guide(line, corner, color) {
    const isNext = corner === this.upcoming;
    this.context.globalAlpha = isNext ? 1 : 0.5;
    this.context.lineWidth = isNext ? 2 : 1;
    this.#line(line, color, [6, 4]);
    this.context.globalAlpha = 1;
  }

  #corner(place, number, color, isMarked) {
    const [x, y] = this.toCanvas(place);
    const context = this.context;
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.lineWidth = 2;
    context.strokeStyle = isMarked ? "#fff" : color;
    context.fillStyle = isMarked ? color : "#0008";
    context.fill();
    context.stroke();
    context.font = "bold 12px system-ui, sans-serif";
    context.lineWidth = 3;
    context.strokeStyle = "#000";
    context.strokeText(String(number + 1), x + 9, y - 7);
    context.fillStyle = "#fff";
    context.fillText(String(number + 1), x + 9, y - 7);
  }

  #pending(pending, color) {
    const context = this.context;
    if (pending.kind === "brush") {
      if (pending.points.length) {
        context.globalAlpha = 0.5;
        context.fillStyle = pending.effect === "cut" ? "#fff" : color;
        this.#stroke(context, pending);
        context.globalAlpha = 1;
      }
      return;
    }
    context.lineWidth = 2;
    this.#line(pending.points, "#fff", [4, 3]);
  }

  // The corner of a pane under the pointer: marked ones first, then those that only the fit knows.
  cornerAt(pane, answer, place, reach) {
    const { name, number } = this.view;
    const near = (spot) => spot && distance(spot, place) < reach;
    const marked = pane.corners.findIndex((places) => name in places && near(places[name]));
    if (marked >= 0) return marked;
    if (!answer || !answer.solved) return -1;
    return answer.corners[number].findIndex((spot, corner) => near(spot) && pane.corners[corner] && !(name in pane.corners[corner]));
  }

  // Whether a stroke covers a place of the view.
  covers(stroke, place) {
    if (stroke.kind === "brush") {
      const points = stroke.points.length > 1 ? stroke.points : [stroke.points[0], stroke.points[0]];
      return points.slice(1).some((point, index) => fromSegment(place, points[index], point) <= stroke.radius);
    }
    const path = new Path2D();
    stroke.points.forEach((point, index) => path[index ? "lineTo" : "moveTo"](...point));
    this.context.save();
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    const inside = this.context.isPointInPath(path, place[0], place[1]);
    this.context.restore();
    return inside;
  }
}
