// Sequential colour map, uniform in OKLab (B. Ottosson, 2020): lightness rises evenly, hue goes from violet over teal
// to yellow. Lightness alone orders the colours, so the map is safe for colour-blind eyes and in grey print.

const STEPS = 256;
const DARKEST = 0.25;
const LIGHTEST = 0.94;
const HUES_DEG = [300, 270, 235, 195, 155, 125, 104];
const LARGEST_CHROMA = 0.13;

/** The colours of the map from its lower to its upper end: [red, green, blue] from 0 to 255. */
export const COLOURS = equallySpaced(path(2000), STEPS);

/** The colours as 32-bit numbers for a Uint32Array over ImageData, on little-endian machines. */
export const PIXELS = Uint32Array.from(COLOURS, ([red, green, blue]) => ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0);

/** Index into COLOURS of a value, where low and high are the ends of the scale. Values beyond them take the ends. */
export function colourIndex(value, low, high) {
  const share = (value - low) / (high - low);
  return share > 0 ? Math.min(Math.floor(share * STEPS), STEPS - 1) : 0;
}

/** A colour of the map for CSS. */
export function cssColour(index) {
  return `rgb(${COLOURS[index].join(" ")})`;
}

/** Points of the path through OKLab, with their colours: the most chroma up to a limit that sRGB can show. */
function path(count) {
  const points = [];
  for (let k = 0; k < count; k++) {
    const share = k / (count - 1);
    const lightness = DARKEST + (LIGHTEST - DARKEST) * share;
    const hue = (interpolated(HUES_DEG, share) * Math.PI) / 180;
    let [least, most] = [0, LARGEST_CHROMA];
    for (let halving = 0; halving < 20; halving++) {
      const chroma = (least + most) / 2;
      if (isInside(toLinear(lightness, chroma, hue))) least = chroma;
      else most = chroma;
    }
    points.push({ lab: [lightness, least * Math.cos(hue), least * Math.sin(hue)], linear: toLinear(lightness, least, hue) });
  }
  return points;
}

/** Colours at equal distances along the path. */
function equallySpaced(points, count) {
  const lengths = [0];
  for (let k = 1; k < points.length; k++) lengths.push(lengths[k - 1] + distance(points[k - 1].lab, points[k].lab));
  const whole = lengths[lengths.length - 1];
  let at = 0;
  return Array.from({ length: count }, (_, k) => {
    const wanted = (whole * k) / (count - 1);
    while (at < points.length - 1 && lengths[at] < wanted) at++;
    return points[at].linear.map(toByte);
  });
}

function interpolated(values, share) {
  const place = share * (values.length - 1);
  const before = Math.min(Math.floor(place), values.length - 2);
  return values[before] + (values[before + 1] - values[before]) * (place - before);
}

function distance(one, other) {
  return Math.hypot(...one.map((value, k) => value - other[k]));
}

/** OKLab, in polar form, to linear sRGB. */
function toLinear(lightness, chroma, hue) {
  const [a, b] = [chroma * Math.cos(hue), chroma * Math.sin(hue)];
  const long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const short = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
    -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
    -0.0041960863 * long - 0.7034186147 * medium + 1.707614701 * short,
  ];
}

function isInside(linear) {
  return linear.every((part) => part >= 0 && part <= 1);
}

function toByte(linear) {
  const part = Math.min(Math.max(linear, 0), 1);
  const encoded = part <= 0.0031308 ? 12.92 * part : 1.055 * part ** (1 / 2.4) - 0.055;
  return Math.round(255 * encoded);
}
