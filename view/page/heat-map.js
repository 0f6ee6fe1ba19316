// Heat map without interpolation: one pixel per cell, enlarged by whole device pixels. Contacts lie on a second canvas.

import { PIXELS, colourIndex } from "./colours.js";
import { ids, newtons, tickLabel } from "./numbers.js";

const MARGIN = 26; // CSS pixels for the numbers of rows and columns
const LEAST_CELL_WITH_GAP = 9; // device pixels
const PATCH_SHARE = 0.15; // of a contact's peak: cells above belong to what presses there
const GAP_COLOUR = "rgb(255 255 255 / 0.16)";
const FONT = 'px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

export class HeatMap {
  /** @param holder element of both canvases; cells: canvas of the cells; marks: canvas above it */
  constructor(holder, cells, marks) {
    Object.assign(this, { holder, cells, marks });
    this.image = document.createElement("canvas");
    this.unreadKey = "";
  }

  /**
   * Lays the map out for an array within some CSS pixels.
   * @param view {turns, mirrored, pitch_mm}: quarter turns clockwise, after mirroring left and right; pitch_mm: [x, y]
   *   for numbers in mm beside the map, null for numbers of rows and columns
   */
  layOut(rows, columns, width, height, colours, view) {
    const ratio = globalThis.devicePixelRatio || 1;
    Object.assign(this, { rows, columns, ratio, colours, view });
    [this.across, this.down] = view.turns % 2 ? [rows, columns] : [columns, rows];
    const room = [(width - 2 * MARGIN) / this.across, (height - 2 * MARGIN) / this.down];
    this.side = Math.max(Math.floor(Math.min(...room) * ratio), 1);
    this.margin = Math.round(MARGIN * ratio);
    const across = 2 * this.margin + this.across * this.side;
    const down = 2 * this.margin + this.down * this.side;
    for (const canvas of [this.cells, this.marks]) {
      canvas.width = across;
      canvas.height = down;
      canvas.style.width = `${across / ratio}px`;
      canvas.style.height = `${down / ratio}px`;
    }
    this.holder.style.width = `${across / ratio}px`;
    this.holder.style.height = `${down / ratio}px`;
    this.image.width = this.across;
    this.image.height = this.down;
    this.imageContext = this.image.getContext("2d");
    this.pixels = this.imageContext.createImageData(this.across, this.down);
    this.words = new Uint32Array(this.pixels.data.buffer);
    this.pixelOf = Uint32Array.from({ length: rows * columns }, (_, k) => {
      const [x, y] = this.squareOf(k);
      return y * this.across + x;
    });
    this.cellOf = new Uint32Array(rows * columns);
    this.pixelOf.forEach((pixel, k) => (this.cellOf[pixel] = k));
    this.context = this.cells.getContext("2d");
    this.markContext = this.marks.getContext("2d");
    this.hatching = this.context.createPattern(hatchTile(ratio, colours), "repeat");
    this.unreadKey = "";
    this.grid = this.gridPath();
    this.drawNumbers();
  }

  /** Where a point of the skin lies on the map; both in sides of a cell from the upper left corner. */
  turned(x, y) {
    let [across, down] = [this.columns, this.rows];
    let [left, top] = [this.view.mirrored ? across - x : x, y];
    for (let k = 0; k < this.view.turns; k++) {
      [left, top] = [down - top, left];
      [across, down] = [down, across];
    }
    return [left, top];
  }

  /** Column and row on the map of a cell. */
  squareOf(index) {
    return this.turned((index % this.columns) + 0.5, Math.floor(index / this.columns) + 0.5).map(Math.floor);
  }

  /** Draws values of the cells on a scale from low to high; cells that are not valid are hatched. */
  drawCells(values, valid, low, high) {
    const { words, pixelOf, context, side, margin } = this;
    let unread = 0;
    for (let k = 0; k < values.length; k++) {
      const value = values[k];
      if (valid[k] && value === value) words[pixelOf[k]] = PIXELS[colourIndex(value, low, high)];
      else {
        words[pixelOf[k]] = 0;
        unread++;
      }
    }
    this.imageContext.putImageData(this.pixels, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.image, margin, margin, this.across * side, this.down * side);
    if (unread) this.hatch(values, valid);
    if (this.grid) {
      context.strokeStyle = GAP_COLOUR;
      context.lineWidth = 1;
      context.stroke(this.grid);
    }
  }

  /** Hatches the cells that are not valid. Their outline is kept as long as they stay the same. */
  hatch(values, valid) {
    const places = [];
    for (let k = 0; k < values.length; k++) if (!valid[k] || values[k] !== values[k]) places.push(k);
    const key = places.join(",");
    if (key !== this.unreadKey) {
      this.unreadKey = key;
      this.unreadPath = new Path2D();
      for (const k of places) this.unreadPath.rect(...this.corner(k), this.side, this.side);
    }
    this.context.fillStyle = this.hatching;
    this.context.fill(this.unreadPath);
  }

  /** Draws contacts, the cells that are plotted, and the cell under the pointer. */
  drawMarks(frame, pitch_mm, chosen, pointed) {
    const { markContext: context, ratio } = this;
    const { contacts } = frame;
    context.clearRect(0, 0, this.marks.width, this.marks.height);
    chosen.forEach(({ index, colour }) => this.outline(index, colour, 2.5));
    if (pointed !== null) this.outline(pointed, "#ffffff", 1.5);
    context.font = `600 ${Math.round(12 * ratio)}${FONT}`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    const circles = contacts.map((contact) => this.circle(contact, pitch_mm));
    const places = contacts.map((contact, k) => {
      if (!contact.joined.length) return this.drawCircle(circles[k]);
      return this.drawPatch(this.patch(frame, contact, circles, k)) ?? this.drawCircle(circles[k]);
    });
    this.drawLabels(contacts, places);
  }

  /** Centre and radius of the circle with a contact's area. */
  circle(contact, pitch_mm) {
    const at = this.turned(contact.x_mm / pitch_mm[0] + 0.5, contact.y_mm / pitch_mm[1] + 0.5);
    const [x, y] = at.map((sides) => this.margin + sides * this.side);
    const radius = Math.sqrt(contact.area_mm2 / (Math.PI * pitch_mm[0] * pitch_mm[1])) * this.side;
    return [x, y, Math.max(radius, 5 * this.ratio)];
  }

  drawCircle([x, y, radius]) {
    const cross = 4 * this.ratio;
    const path = new Path2D();
    path.arc(x, y, radius, 0, 2 * Math.PI);
    path.moveTo(x - cross, y);
    path.lineTo(x + cross, y);
    path.moveTo(x, y - cross);
    path.lineTo(x, y + cross);
    this.strokeMark(path);
    return [x, y, radius];
  }

  /** Draws the outline of some cells; returns where a label goes. The centre of fingers that met may press nothing. */
  drawPatch({ cells, hottest }) {
    if (!cells.size) return null;
    const { side } = this;
    const path = new Path2D();
    for (const index of cells) {
      const [x, y] = this.corner(index);
      const [column, row] = this.squareOf(index);
      const edges = [
        [column, row - 1, x, y, x + side, y],
        [column, row + 1, x, y + side, x + side, y + side],
        [column - 1, row, x, y, x, y + side],
        [column + 1, row, x + side, y, x + side, y + side],
      ];
      for (const [across, down, ...line] of edges) {
        const inside = across >= 0 && down >= 0 && across < this.across && down < this.down;
        if (inside && cells.has(this.cellOf[down * this.across + across])) continue;
        path.moveTo(line[0], line[1]);
        path.lineTo(line[2], line[3]);
      }
    }
    this.strokeMark(path);
    const [x, y] = this.corner(hottest);
    return [x + side / 2, y + side / 2, side];
  }

  /** The cells of contact k: those under pressure that lie nearest to its circle. */
  patch(frame, contact, circles, k) {
    const cells = new Set();
    let hottest = -1;
    const least = PATCH_SHARE * contact.peak_kpa;
    const distance = ([x, y, radius], at) => Math.hypot(at[0] - x, at[1] - y) - radius;
    for (let index = 0; index < frame.pressure.length; index++) {
      if (!frame.valid[index] || !(frame.pressure[index] >= least)) continue;
      const middle = this.corner(index).map((corner) => corner + this.side / 2);
      const own = distance(circles[k], middle);
      if (own > circles[k][2] || circles.some((circle, other) => other !== k && distance(circle, middle) < own)) continue;
      cells.add(index);
      if (hottest < 0 || frame.pressure[index] > frame.pressure[hottest]) hottest = index;
    }
    return { cells, hottest };
  }

  strokeMark(path) {
    const { markContext: context, ratio } = this;
    for (const [width, colour] of [
      [4, "rgb(0 0 0 / 0.6)"],
      [1.75, "#ffffff"],
    ]) {
      context.lineWidth = width * ratio;
      context.strokeStyle = colour;
      context.stroke(path);
    }
  }

  /** Writes id and force beside each contact, where no label of a stronger contact is. */
  drawLabels(contacts, places) {
    const { markContext: context, ratio } = this;
    const height = 17 * ratio;
    const taken = [];
    contacts.forEach((contact, k) => {
      const [x, y, radius] = places[k];
      const text = `${ids(contact)}: ${newtons(contact)} N`;
      const width = context.measureText(text).width;
      const [aside, off] = [0.72 * radius + 6 * ratio, 0.72 * radius + 8 * ratio];
      const corners = [y - off, y + off].flatMap((line) => [
        [x + aside, line],
        [x - aside - width, line],
      ]);
      const pad = 3 * ratio;
      const boxes = corners.map(([left, line]) => [left - pad, line - height / 2, left + width + pad, line + height / 2]);
      const free = boxes.findIndex((box) => this.holds(box) && !taken.some((other) => overlap(box, other)));
      const chosen = free >= 0 ? free : Math.max(boxes.findIndex((box) => this.holds(box)), 0);
      taken.push(boxes[chosen]);
      const [left, top, right, bottom] = boxes[chosen];
      context.fillStyle = "rgb(16 18 22 / 0.82)"; // readable on hatching, too
      context.beginPath();
      context.roundRect(left, top, right - left, bottom - top, 3 * ratio);
      context.fill();
      context.fillStyle = "#ffffff";
      context.fillText(text, ...corners[chosen]);
    });
  }

  /** Whether a box [left, top, right, bottom] lies on the canvas. */
  holds([left, top, right, bottom]) {
    return left >= 0 && top >= 0 && right <= this.marks.width && bottom <= this.marks.height;
  }

  outline(index, colour, width) {
    const { markContext: context, ratio, side } = this;
    const [x, y] = this.corner(index);
    for (const [extra, paint] of [
      [2, "rgb(0 0 0 / 0.65)"],
      [0, colour],
    ]) {
      context.lineWidth = (width + extra) * ratio;
      context.strokeStyle = paint;
      context.strokeRect(x, y, side, side);
    }
  }

  /** Gives the element back to another map. */
  leave() {}

  /** Whether a press of the pointer has turned the skin: a flat map turns by quarters only. */
  hasTurned() {
    return false;
  }

  /** The next cell in a direction on the map; the first one if there is none. */
  step(index, down, along) {
    const [x, y] = this.squareOf(index ?? 0);
    const { across, down: tall } = this;
    return this.cellOf[((y + down + tall) % tall) * across + ((x + along + across) % across)];
  }

  /** Index of the cell at a pointer event; null beside the map. */
  cellAt(event) {
    const box = this.cells.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) * this.ratio - this.margin) / this.side);
    const row = Math.floor(((event.clientY - box.top) * this.ratio - this.margin) / this.side);
    const inside = row >= 0 && column >= 0 && row < this.down && column < this.across;
    return inside ? this.cellOf[row * this.across + column] : null;
  }

  /** Upper left corner of a cell in device pixels. */
  corner(index) {
    return this.squareOf(index).map((square) => this.margin + square * this.side);
  }

  gridPath() {
    if (this.side < LEAST_CELL_WITH_GAP) return null;
    const grid = new Path2D();
    const [right, bottom] = [this.margin + this.across * this.side, this.margin + this.down * this.side];
    for (let column = 1; column < this.across; column++) {
      const x = this.margin + column * this.side + 0.5;
      grid.moveTo(x, this.margin);
      grid.lineTo(x, bottom);
    }
    for (let row = 1; row < this.down; row++) {
      const y = this.margin + row * this.side + 0.5;
      grid.moveTo(this.margin, y);
      grid.lineTo(right, y);
    }
    return grid;
  }

  drawNumbers() {
    const { context, ratio, side, margin } = this;
    context.clearRect(0, 0, this.cells.width, this.cells.height);
    context.fillStyle = this.colours["soft-ink"];
    context.font = `${Math.round(11 * ratio)}${FONT}`;
    context.textAlign = "center";
    context.textBaseline = "alphabetic";
    const above = this.labels(0);
    const beside = this.labels(1);
    const every = (labels) => {
      const widest = Math.max(...labels.map((label) => context.measureText(label).width), 14 * ratio);
      return [1, 2, 4, 8, 16, 32].find((step) => step * side >= widest + 8 * ratio) ?? 64;
    };
    for (let column = 0; column < this.across; column += every(above))
      context.fillText(above[column], margin + (column + 0.5) * side, margin - 6 * ratio);
    context.textAlign = "right";
    context.textBaseline = "middle";
    const step = [1, 2, 4, 8, 16, 32].find((rows) => rows * side >= 22 * ratio) ?? 64;
    for (let row = 0; row < this.down; row += step)
      context.fillText(beside[row], margin - 4 * ratio, margin + (row + 0.5) * side);
    if (this.view.pitch_mm) {
      context.textAlign = "left";
      context.fillText("mm", 2 * ratio, margin - 9 * ratio);
    }
  }

  /** Numbers above (axis 0) or beside (axis 1) the map: of columns or rows, or of millimetres. */
  labels(axis) {
    const ofRows = (this.view.turns + axis) % 2 === 1;
    const count = axis === 0 ? this.across : this.down;
    const numbers = Array.from({ length: count }, (_, k) => {
      const index = this.cellOf[axis === 0 ? k : k * this.across];
      const number = ofRows ? Math.floor(index / this.columns) : index % this.columns;
      return this.view.pitch_mm ? number * this.view.pitch_mm[ofRows ? 1 : 0] : number;
    });
    const sorted = [...numbers].sort((one, other) => one - other);
    return numbers.map((number) => (this.view.pitch_mm ? tickLabel(number, sorted) : String(number)));
  }

  /** Both canvases on one, for a picture. */
  picture() {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [this.cells.width, this.cells.height];
    const context = canvas.getContext("2d");
    context.fillStyle = this.colours.card;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(this.cells, 0, 0);
    context.drawImage(this.marks, 0, 0);
    return canvas;
  }
}

function overlap(one, other) {
  return one[0] < other[2] && other[0] < one[2] && one[1] < other[3] && other[1] < one[3];
}

/** A tile with diagonal lines on neutral grey, which the colour map does not have. */
export function hatchTile(ratio, colours) {
  const size = Math.max(Math.round(6 * ratio), 4);
  const tile = document.createElement("canvas");
  tile.width = tile.height = size;
  const context = tile.getContext("2d");
  context.fillStyle = colours["hatch-ground"];
  context.fillRect(0, 0, size, size);
  context.strokeStyle = colours["hatch-line"];
  context.lineWidth = 1.25 * ratio;
  for (const shift of [-size, 0, size]) {
    context.beginPath();
    context.moveTo(shift - 1, size + 1);
    context.lineTo(shift + size + 1, -1);
    context.stroke();
  }
  return tile;
}
