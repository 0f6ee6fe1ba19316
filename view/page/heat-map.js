// Heat map without interpolation: one pixel per cell, enlarged by whole device pixels. Contacts lie on a second canvas.

import { PIXELS, colourIndex } from "./colours.js";
import { haloText } from "./canvas.js";
import { fixed, ids } from "./numbers.js";

const MARGIN = 26; // CSS pixels for the numbers of rows and columns
const LEAST_CELL_WITH_GAP = 9; // device pixels
const GAP_COLOUR = "rgb(255 255 255 / 0.16)";
const FONT = 'px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

export class HeatMap {
  /** @param holder element of both canvases; cells: canvas of the cells; marks: canvas above it */
  constructor(holder, cells, marks) {
    Object.assign(this, { holder, cells, marks });
    this.image = document.createElement("canvas");
    this.unreadKey = "";
  }

  /** Lays the map out for an array within some CSS pixels. */
  layOut(rows, columns, width, height, colours) {
    const ratio = globalThis.devicePixelRatio || 1;
    const room = [(width - 2 * MARGIN) / columns, (height - 2 * MARGIN) / rows];
    this.side = Math.max(Math.floor(Math.min(...room) * ratio), 1);
    this.margin = Math.round(MARGIN * ratio);
    Object.assign(this, { rows, columns, ratio, colours });
    const across = 2 * this.margin + columns * this.side;
    const down = 2 * this.margin + rows * this.side;
    for (const canvas of [this.cells, this.marks]) {
      canvas.width = across;
      canvas.height = down;
      canvas.style.width = `${across / ratio}px`;
      canvas.style.height = `${down / ratio}px`;
    }
    this.holder.style.width = `${across / ratio}px`;
    this.holder.style.height = `${down / ratio}px`;
    this.image.width = columns;
    this.image.height = rows;
    this.imageContext = this.image.getContext("2d");
    this.pixels = this.imageContext.createImageData(columns, rows);
    this.words = new Uint32Array(this.pixels.data.buffer);
    this.context = this.cells.getContext("2d");
    this.markContext = this.marks.getContext("2d");
    this.hatching = this.context.createPattern(hatchTile(ratio, colours), "repeat");
    this.unreadKey = "";
    this.grid = this.gridPath();
    this.drawNumbers();
  }

  /** Draws values of the cells on a scale from low to high; cells that are not valid are hatched. */
  drawCells(values, valid, low, high) {
    const { words, context, side, margin } = this;
    let unread = 0;
    for (let k = 0; k < values.length; k++) {
      const value = values[k];
      if (valid[k] && value === value) words[k] = PIXELS[colourIndex(value, low, high)];
      else {
        words[k] = 0;
        unread++;
      }
    }
    this.imageContext.putImageData(this.pixels, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.image, margin, margin, this.columns * side, this.rows * side);
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
  drawMarks(contacts, pitch_mm, chosen, pointed) {
    const { markContext: context, ratio } = this;
    context.clearRect(0, 0, this.marks.width, this.marks.height);
    chosen.forEach(({ index, colour }) => this.outline(index, colour, 2.5));
    if (pointed !== null) this.outline(pointed, "#ffffff", 1.5);
    context.font = `600 ${Math.round(12 * ratio)}${FONT}`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    const places = contacts.map((contact) => this.drawContact(contact, pitch_mm));
    this.drawLabels(contacts, places);
  }

  drawContact(contact, pitch_mm) {
    const { markContext: context, ratio, side } = this;
    const x = this.margin + (contact.x_mm / pitch_mm[0] + 0.5) * side;
    const y = this.margin + (contact.y_mm / pitch_mm[1] + 0.5) * side;
    const radius = Math.max((Math.sqrt(contact.area_mm2 / (Math.PI * pitch_mm[0] * pitch_mm[1]))) * side, 5 * ratio);
    for (const [width, colour] of [
      [4, "rgb(0 0 0 / 0.6)"],
      [1.75, "#ffffff"],
    ]) {
      context.beginPath();
      context.arc(x, y, radius, 0, 2 * Math.PI);
      context.moveTo(x - 4 * ratio, y);
      context.lineTo(x + 4 * ratio, y);
      context.moveTo(x, y - 4 * ratio);
      context.lineTo(x, y + 4 * ratio);
      context.lineWidth = width * ratio;
      context.strokeStyle = colour;
      context.stroke();
    }
    return [x, y, radius];
  }

  /** Writes id and force beside each contact, where no label of a stronger contact is. */
  drawLabels(contacts, places) {
    const { markContext: context, ratio } = this;
    const height = 15 * ratio;
    const taken = [];
    contacts.forEach((contact, k) => {
      const [x, y, radius] = places[k];
      const text = `${ids(contact)}: ${fixed(contact.force_n, contact.force_n < 0.995 ? 2 : 1)} N`;
      const width = context.measureText(text).width;
      const [aside, off] = [0.72 * radius + 4 * ratio, 0.72 * radius + 6 * ratio];
      const corners = [y - off, y + off].flatMap((line) => [
        [x + aside, line],
        [x - aside - width, line],
      ]);
      const boxes = corners.map(([left, line]) => [left, line - height / 2, left + width, line + height / 2]);
      const free = boxes.findIndex((box) => this.holds(box) && !taken.some((other) => overlap(box, other)));
      const chosen = free >= 0 ? free : Math.max(boxes.findIndex((box) => this.holds(box)), 0);
      taken.push(boxes[chosen]);
      haloText(context, text, ...corners[chosen], ratio);
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

  /** Index of the cell at a pointer event; null beside the map. */
  cellAt(event) {
    const box = this.cells.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) * this.ratio - this.margin) / this.side);
    const row = Math.floor(((event.clientY - box.top) * this.ratio - this.margin) / this.side);
    const inside = row >= 0 && column >= 0 && row < this.rows && column < this.columns;
    return inside ? row * this.columns + column : null;
  }

  /** Upper left corner of a cell in device pixels. */
  corner(index) {
    const row = Math.floor(index / this.columns);
    const column = index % this.columns;
    return [this.margin + column * this.side, this.margin + row * this.side];
  }

  gridPath() {
    if (this.side < LEAST_CELL_WITH_GAP) return null;
    const grid = new Path2D();
    const [right, bottom] = [this.margin + this.columns * this.side, this.margin + this.rows * this.side];
    for (let column = 1; column < this.columns; column++) {
      const x = this.margin + column * this.side + 0.5;
      grid.moveTo(x, this.margin);
      grid.lineTo(x, bottom);
    }
    for (let row = 1; row < this.rows; row++) {
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
    const every = [1, 2, 4, 8, 16, 32].find((step) => step * side >= 22 * ratio) ?? 64;
    context.textAlign = "center";
    context.textBaseline = "alphabetic";
    for (let column = 0; column < this.columns; column += every)
      context.fillText(column, margin + (column + 0.5) * side, margin - 6 * ratio);
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let row = 0; row < this.rows; row += every)
      context.fillText(row, margin - 6 * ratio, margin + (row + 0.5) * side);
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
