// The map of a skin that is no rectangle: each cell at its own place and as large as it is, flat or seen in space.

import { colourIndex, cssColour } from "./colours.js";
import { HeatMap, hatchTile } from "./heat-map.js";

const MARGIN = 26; // CSS pixels
const REACH = 0.66; // of the side of a square of the cell's area: what lies further away is not the cell's
const CORNERS = 24; // of a cell that no neighbour cuts
const TURN_PER_PIXEL = 0.01; // rad
const OBLIQUE = [0.6, -0.5]; // rad about the vertical and the horizontal axis, from which a skin in space is seen first
const FARTHEST_SHADE = 0.45; // by which what lies behind is darker
const FONT = 'px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

export class ShapeMap extends HeatMap {
  /** @param shape {index, place_mm, area_mm2} of each cell that there is; turned: called when the pointer has turned it */
  constructor(holder, cells, marks, shape, turned) {
    super(holder, cells, marks);
    Object.assign(this, { shape, onTurn: turned, angles: [...OBLIQUE], dragged: false });
    this.inSpace = shape.place_mm[0].length === 3;
    this.numberOf = new Map(shape.index.map((index, k) => [index, k]));
    const middle = shape.place_mm[0].map((_, axis) => {
      const along = shape.place_mm.map((place) => place[axis]);
      return (Math.min(...along) + Math.max(...along)) / 2;
    });
    this.middle = middle;
    this.radius = Math.max(...shape.place_mm.map((place) => Math.hypot(...place.map((x, axis) => x - middle[axis]))));
    this.listener = (event) => this.drag(event);
    if (this.inSpace) holder.addEventListener("pointermove", this.listener);
  }

  /** Gives the element back to another map. */
  leave() {
    this.holder.removeEventListener("pointermove", this.listener);
  }

  drag(event) {
    if (!(event.buttons & 1)) return;
    this.dragged = true;
    this.angles[0] += TURN_PER_PIXEL * event.movementX;
    this.angles[1] -= TURN_PER_PIXEL * event.movementY;
    this.onTurn();
  }

  /** Where a place in mm is seen: mm to the right, down, and away from the eye. */
  seen(place) {
    let [x, y, z] = place.map((value, axis) => value - this.middle[axis]);
    if (this.inSpace) {
      const [[s, c], [t, d]] = this.angles.map((angle) => [Math.sin(angle), Math.cos(angle)]);
      [x, z] = [c * x + s * z, c * z - s * x];
      [y, z] = [d * y - t * z, d * z + t * y];
    } else z = 0;
    if (this.view.mirrored) x = -x;
    for (let k = 0; k < this.view.turns; k++) [x, y] = [-y, x];
    return [x, y, z];
  }

  layOut(rows, columns, width, height, colours, view) {
    const ratio = globalThis.devicePixelRatio || 1;
    Object.assign(this, { rows, columns, ratio, colours, view });
    const { shape } = this;
    const sides = shape.area_mm2.map(Math.sqrt);
    const places = shape.place_mm.map((place) => this.seen(place));
    const reach = Math.max(...sides) * REACH;
    let ends = [0, 1].map((axis) => {
      const along = places.map((place) => place[axis]);
      return [Math.min(...along) - reach, Math.max(...along) + reach];
    });
    if (this.inSpace) ends = [0, 1].map(() => [-this.radius - reach, this.radius + reach]);
    this.margin = Math.round(MARGIN * ratio);
    const room = [width - 2 * MARGIN, height - 2 * MARGIN];
    this.perMm = Math.max(Math.min(...ends.map(([low, high], axis) => room[axis] / (high - low))) * ratio, 0.01);
    this.origin = ends.map(([low]) => this.margin - low * this.perMm);
    const size = ends.map(([low, high]) => Math.round((high - low) * this.perMm) + 2 * this.margin);
    for (const canvas of [this.cells, this.marks]) {
      [canvas.width, canvas.height] = size;
      [canvas.style.width, canvas.style.height] = size.map((pixels) => `${pixels / ratio}px`);
    }
    this.holder.style.width = `${size[0] / ratio}px`;
    this.holder.style.height = `${size[1] / ratio}px`;
    this.context = this.cells.getContext("2d");
    this.markContext = this.marks.getContext("2d");
    this.hatching = this.context.createPattern(hatchTile(ratio, colours), "repeat");
    this.middles = places.map((place) => this.pixels(place));
    this.paths = this.middles.map((_, k) => pathOf(this.polygon(k, sides[k] * REACH * this.perMm)));
    const depths = places.map((place) => place[2]);
    this.order = depths.map((_, k) => k).sort((one, other) => depths[other] - depths[one]); // the furthest first
    this.shades = depths.map((depth) => (this.inSpace ? (FARTHEST_SHADE * (depth / this.radius + 1)) / 2 : 0));
  }

  pixels([x, y]) {
    return [this.origin[0] + x * this.perMm, this.origin[1] + y * this.perMm];
  }

  /** Corners of a cell: its surroundings, cut where others are nearer (Voronoi); in space a disc. */
  polygon(k, reach) {
    const [x, y] = this.middles[k];
    let corners = Array.from({ length: CORNERS }, (_, corner) => {
      const angle = (2 * Math.PI * (corner + 0.5)) / CORNERS;
      return [reach * Math.cos(angle), reach * Math.sin(angle)];
    });
    const others = this.inSpace ? [] : this.middles.map(([left, top]) => [left - x, top - y]);
    for (const [across, down] of others) {
      const square = across * across + down * down;
      if (square > 0 && square < 4 * reach * reach) corners = cut(corners, across, down, square / 2);
    }
    return corners.map(([across, down]) => [x + across, y + down]);
  }

  drawCells(values, valid, low, high) {
    const { context, shape } = this;
    context.clearRect(0, 0, this.cells.width, this.cells.height);
    context.lineWidth = 1;
    for (const k of this.order) {
      const index = shape.index[k];
      const value = values[index];
      const read = valid[index] && value === value;
      context.fillStyle = read ? cssColour(colourIndex(value, low, high)) : this.hatching;
      context.fill(this.paths[k]);
      if (this.shades[k] > 0) {
        context.fillStyle = `rgb(0 0 0 / ${this.shades[k]})`;
        context.fill(this.paths[k]);
      }
      context.strokeStyle = this.colours.card;
      context.stroke(this.paths[k]);
    }
    this.drawLength();
  }

  /** A line of a round length in mm, below the cells. */
  drawLength() {
    const { context, ratio } = this;
    const longest = (0.3 * (this.cells.width - 2 * this.margin)) / this.perMm;
    const step = 10 ** Math.floor(Math.log10(longest));
    const length = [5, 2, 1].find((times) => times * step <= longest) * step;
    const y = this.cells.height - 8 * ratio;
    context.fillStyle = context.strokeStyle = this.colours["soft-ink"];
    context.lineWidth = 1.5 * ratio;
    context.beginPath();
    context.moveTo(this.margin, y);
    context.lineTo(this.margin + length * this.perMm, y);
    context.stroke();
    context.font = `${Math.round(11 * ratio)}${FONT}`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillText(`${Number(length.toPrecision(1))} mm`, this.margin + length * this.perMm + 6 * ratio, y);
  }

  circle(contact) {
    const place = [contact.x_mm, contact.y_mm, contact.z_mm].slice(0, this.middle.length);
    const [x, y] = this.pixels(this.seen(place));
    return [x, y, Math.max(Math.sqrt(contact.area_mm2 / Math.PI) * this.perMm, 5 * this.ratio)];
  }

  /** Fingers that met are shown by their circle: cells that touch have no common grid here. */
  drawPatch() {
    return null;
  }

  patch() {
    return null;
  }

  outline(index, colour, width) {
    const path = this.paths[this.numberOf.get(index)];
    if (!path) return;
    const { markContext: context, ratio } = this;
    for (const [extra, paint] of [
      [2, "rgb(0 0 0 / 0.65)"],
      [0, colour],
    ]) {
      context.lineWidth = (width + extra) * ratio;
      context.strokeStyle = paint;
      context.stroke(path);
    }
  }

  cellAt(event) {
    const box = this.cells.getBoundingClientRect();
    const at = [(event.clientX - box.left) * this.ratio, (event.clientY - box.top) * this.ratio];
    const k = this.order.findLast((each) => this.context.isPointInPath(this.paths[each], ...at));
    return k === undefined ? null : this.shape.index[k];
  }

  /** Whether a press of the pointer has turned the skin, and chooses no cell. */
  hasTurned() {
    const turned = this.dragged;
    this.dragged = false;
    return turned;
  }

  /** The next cell in a direction, within 45 degrees of it; the same one if there is none. */
  step(index, down, along) {
    const [x, y] = this.middles[this.numberOf.get(index) ?? 0];
    let [best, least] = [index ?? this.shape.index[0], Infinity];
    this.middles.forEach(([left, top], k) => {
      const ahead = (left - x) * along + (top - y) * down;
      const aside = Math.abs((left - x) * down + (top - y) * along);
      if (ahead > 0 && aside <= ahead && ahead + aside < least) [best, least] = [this.shape.index[k], ahead + aside];
    });
    return best;
  }
}

/** A convex polygon about the origin, without what is nearer to the point (across, down). */
function cut(corners, across, down, half) {
  const kept = [];
  corners.forEach((corner, k) => {
    const next = corners[(k + 1) % corners.length];
    const [beyond, nextBeyond] = [corner, next].map((point) => point[0] * across + point[1] * down - half);
    if (beyond <= 0) kept.push(corner);
    if (beyond < 0 !== nextBeyond < 0 && beyond !== nextBeyond) {
      const share = beyond / (beyond - nextBeyond);
      kept.push([corner[0] + share * (next[0] - corner[0]), corner[1] + share * (next[1] - corner[1])]);
    }
  });
  return kept;
}

function pathOf(corners) {
  const path = new Path2D();
  corners.forEach((corner, k) => (k ? path.lineTo(...corner) : path.moveTo(...corner)));
  path.closePath();
  return path;
}
