// Time plot of chosen cells: a line for the pressure and a band of one standard deviation to either side.
// Samples that share a pixel column are drawn as one stretch from the least to the largest, so that no peak is lost.

import { sized } from "./canvas.js";
import { tickLabel, ticks } from "./numbers.js";

const LEFT = 46;
const RIGHT = 14;
const TOP = 10;
const BOTTOM = 24;
const GAP_S = 0.5; // a longer pause between two samples is drawn as a gap

/**
 * Draws the plot.
 * @param lines [{series, colour}]; a series has `length` and `at(k)` -> [time, kPa, standard deviation]
 * @param view {from, to, origin, cursor, least}: times in s; labels count from origin; cursor null for none;
 *   least: value that the vertical axis reaches at least; unit: of the values; threshold: null for none
 */
export function drawPlot(canvas, lines, view, colours) {
  const box = canvas.getBoundingClientRect();
  const { context, ratio } = sizedAs(canvas, box);
  const [width, height] = [box.width, box.height];
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const area = { left: LEFT, right: width - RIGHT, top: TOP, bottom: height - BOTTOM };
  const columns = lines.map(({ series }) => byColumn(series, view, area));
  const [low, high] = verticalRange(columns, Math.max(view.least, view.threshold ?? 0));
  const toY = (kpa) => area.bottom - ((kpa - low) / (high - low)) * (area.bottom - area.top);
  drawAxes(context, area, view, low, high, toY, colours);
  context.save();
  context.beginPath();
  context.rect(area.left, area.top - 2, area.right - area.left, area.bottom - area.top + 4);
  context.clip();
  lines.forEach(({ colour }, k) => drawBand(context, columns[k], toY, colour));
  lines.forEach(({ colour }, k) => drawLine(context, columns[k], toY, colour));
  context.restore();
  if (view.threshold !== null) drawThreshold(context, area, Math.round(toY(view.threshold)) + 0.5, colours);
  if (view.cursor !== null) drawCursor(context, area, view, colours);
}

/** The time at a pointer event; null beside the axes. */
export function timeAt(canvas, event, view) {
  const box = canvas.getBoundingClientRect();
  const share = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
  return share >= 0 && share <= 1 ? view.from + share * (view.to - view.from) : null;
}

function sizedAs(canvas, box) {
  const ratio = globalThis.devicePixelRatio || 1;
  const [across, down] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
  if (canvas.width !== across || canvas.height !== down) [canvas.width, canvas.height] = [across, down];
  return { context: canvas.getContext("2d"), ratio };
}

/** Samples gathered by pixel column: stretches without a gap, each a list of columns. */
function byColumn(series, view, area) {
  const stretches = [];
  let stretch = null;
  let column = null;
  let before = -Infinity;
  const scale = (area.right - area.left) / (view.to - view.from || 1);
  for (let k = firstFrom(series, view.from - GAP_S); k < series.length; k++) {
    const [time, kpa, std] = series.at(k);
    if (time > view.to + GAP_S) break;
    if (kpa !== kpa) {
      stretch = column = null;
      continue;
    }
    const pause = view.gaps && time - before > GAP_S;
    before = time;
    if (stretch === null || pause) {
      stretch = [];
      stretches.push(stretch);
      column = null;
    }
    const x = area.left + (time - view.from) * scale;
    const doubt = std === std ? std : 0;
    if (column !== null && x - column.x < 1) {
      column.least = Math.min(column.least, kpa);
      column.most = Math.max(column.most, kpa);
      column.lower = Math.min(column.lower, kpa - doubt);
      column.upper = Math.max(column.upper, kpa + doubt);
      column.last = kpa;
    } else {
      column = { x, first: kpa, last: kpa, least: kpa, most: kpa, lower: kpa - doubt, upper: kpa + doubt };
      stretch.push(column);
    }
  }
  return stretches;
}

/** Index of the first sample at or after a time; times increase. */
function firstFrom(series, time) {
  let [low, high] = [0, series.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (series.at(middle)[0] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

function verticalRange(columns, least) {
  let [low, high] = [0, least];
  for (const stretch of columns.flat()) {
    for (const column of stretch) {
      low = Math.min(low, column.lower);
      high = Math.max(high, column.upper);
    }
  }
  const room = 0.04 * (high - low);
  return [low < 0 ? low - room : 0, high + room];
}

function drawAxes(context, area, view, low, high, toY, colours) {
  context.font = '11px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
  context.lineWidth = 1;
  context.strokeStyle = colours.edge;
  context.fillStyle = colours["soft-ink"];
  context.textAlign = "right";
  context.textBaseline = "middle";
  const levels = ticks(low, high, 5);
  for (const kpa of levels) {
    const y = Math.round(toY(kpa)) + 0.5;
    line(context, area.left, y, area.right, y);
    context.fillText(tickLabel(kpa, levels), area.left - 7, y);
  }
  context.textBaseline = "top";
  context.textAlign = "center";
  const span = view.to - view.from;
  const most = Math.max(2, Math.floor((area.right - area.left) / 70));
  const times = ticks(view.from - view.origin, view.to - view.origin, most);
  for (const time of times) {
    const x = area.left + ((time + view.origin - view.from) / (span || 1)) * (area.right - area.left);
    context.fillText(`${tickLabel(time, times).replace("-", "−")} s`, Math.min(x, area.right - 8), area.bottom + 7);
  }
  context.save();
  context.translate(11, (area.top + area.bottom) / 2);
  context.rotate(-Math.PI / 2);
  context.textBaseline = "middle";
  context.fillText(view.unit, 0, 0);
  context.restore();
}

function drawBand(context, stretches, toY, colour) {
  context.globalAlpha = 0.22;
  context.fillStyle = colour;
  for (const stretch of stretches) {
    context.beginPath();
    for (const column of stretch) context.lineTo(column.x, toY(column.upper));
    for (const column of stretch.toReversed()) context.lineTo(column.x, toY(column.lower));
    context.closePath();
    context.fill();
  }
  context.globalAlpha = 1;
}

function drawLine(context, stretches, toY, colour) {
  context.strokeStyle = colour;
  context.lineWidth = 1.75;
  context.lineJoin = "round";
  context.beginPath();
  for (const stretch of stretches) {
    stretch.forEach((column, k) => {
      if (k === 0) context.moveTo(column.x, toY(column.first));
      else context.lineTo(column.x, toY(column.first));
      if (column.most > column.least) {
        context.lineTo(column.x, toY(column.least));
        context.lineTo(column.x, toY(column.most));
        context.lineTo(column.x, toY(column.last));
      }
    });
    if (stretch.length === 1) context.lineTo(stretch[0].x + 1, toY(stretch[0].last));
  }
  context.stroke();
}

function drawThreshold(context, area, y, colours) {
  context.strokeStyle = colours.accent;
  context.lineWidth = 1.25;
  context.setLineDash([6, 4]);
  line(context, area.left, y, area.right, y);
  context.setLineDash([]);
}

function drawCursor(context, area, view, colours) {
  const x = area.left + ((view.cursor - view.from) / (view.to - view.from || 1)) * (area.right - area.left);
  context.strokeStyle = colours.ink;
  context.lineWidth = 1;
  line(context, x, area.top, x, area.bottom);
}

function line(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}
