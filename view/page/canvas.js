// Canvases in device pixels, and the page's colours for drawing.

/** Gives a canvas a size in CSS pixels; returns its context, in device pixels, and the ratio of the two. */
export function sized(canvas, width, height) {
  const ratio = globalThis.devicePixelRatio || 1;
  const [across, down] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== across || canvas.height !== down) {
    canvas.width = across;
    canvas.height = down;
    canvas.style.width = `${across / ratio}px`;
    canvas.style.height = `${down / ratio}px`;
  }
  return { context: canvas.getContext("2d"), ratio };
}

/** A colour of style.css by its name. */
export function themeColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** The colours that drawing needs, read once for each theme. */
export function themeColours() {
  const names = ["card", "ink", "soft-ink", "edge", "accent", "hatch-ground", "hatch-line"];
  const colours = Object.fromEntries(names.map((name) => [name, themeColour(name)]));
  colours.series = Array.from({ length: 6 }, (_, k) => themeColour(`series-${k}`));
  return colours;
}
