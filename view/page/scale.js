// The colour scale with its numbers, below the heat map.

import { COLOURS, cssColour } from "./colours.js";
import { sized } from "./canvas.js";
import { hatchTile } from "./heat-map.js";
import { tickLabel, ticks } from "./numbers.js";

const HEIGHT = 36;
const BAR = 12;
const SIDE = 16; // CSS pixels beside the bar, for the outermost numbers

/** Draws the scale from low to high, with the unit at its right end. */
export function drawScale(canvas, width, low, high, unit, colours) {
  const { context, ratio } = sized(canvas, width, HEIGHT);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, HEIGHT);
  context.font = '11px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
  const unitWidth = unit ? context.measureText(unit).width + 8 : 0;
  const length = width - 2 * SIDE - unitWidth;
  for (let pixel = 0; pixel < length * ratio; pixel++) {
    context.fillStyle = cssColour(Math.floor((COLOURS.length * pixel) / (length * ratio)));
    context.fillRect(SIDE + pixel / ratio, 0, 1 / ratio, BAR);
  }
  context.fillStyle = context.strokeStyle = colours["soft-ink"];
  context.textAlign = "center";
  context.textBaseline = "top";
  const values = ticks(low, high, Math.max(2, Math.floor(length / 55)));
  for (const value of values) {
    const x = Math.round(SIDE + (length * (value - low)) / (high - low || 1)) + 0.5;
    context.beginPath();
    context.moveTo(x, BAR);
    context.lineTo(x, BAR + 4);
    context.stroke();
    context.fillText(tickLabel(value, values), x, BAR + 7);
  }
  context.textAlign = "left";
  context.textBaseline = "middle";
  context.fillText(unit, SIDE + length + 8, BAR / 2 + 1);
}

/** Draws a sample of the hatching of cells that are not valid. */
export function drawHatching(canvas, colours) {
  const { context, ratio } = sized(canvas, 22, 12);
  context.fillStyle = context.createPattern(hatchTile(ratio, colours), "repeat");
  context.fillRect(0, 0, canvas.width, canvas.height);
}
