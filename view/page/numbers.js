// Numbers as people read them.

const PREFIXES = [
  [1e9, "G"],
  [1e6, "M"],
  [1e3, "k"],
  [1, ""],
];

/** A number with fixed decimals; a dash where there is none. */
export function fixed(value, decimals) {
  return value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(decimals);
}

/** Resistance with the prefix of its size. */
export function ohm(value) {
  if (!Number.isFinite(value)) return "–";
  const [unit, prefix] = PREFIXES.find(([size]) => Math.abs(value) >= size) ?? [1, ""];
  return `${(value / unit).toPrecision(4)} ${prefix}Ω`;
}

/** Seconds as milliseconds. */
export function milliseconds(value_s) {
  return value_s === null || !Number.isFinite(value_s) ? "–" : (1e3 * value_s).toFixed(1);
}

/** Round values for the ticks of an axis from low to high, at most `most` of them. */
export function ticks(low, high, most) {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return [low];
  const raw = span / most;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw * (1 - 1e-9));
  const found = [];
  for (let k = Math.ceil(low / step - 1e-6); k * step <= high + 1e-6 * step; k++) found.push(k * step);
  return found;
}

/** A tick's label, with as many decimals as its neighbours need. */
export function tickLabel(value, values) {
  const step = values.length > 1 ? Math.abs(values[1] - values[0]) : Math.abs(value);
  if (Math.abs(value) >= 1e4 || (step < 1e-3 && step > 0)) return value.toPrecision(3).replace(/\.?0+(e|$)/, "$1");
  const decimals = step > 0 ? Math.max(0, Math.min(3, -Math.floor(Math.log10(step) + 1e-9))) : 0;
  return value.toFixed(decimals);
}

/** The id of a contact, with those of others that have run into it. */
export function ids(contact) {
  return [contact.id, ...contact.joined].join("+");
}

/** The force of a contact, alike wherever it is written. */
export function newtons(contact) {
  return fixed(contact.force_n, contact.force_n < 9.995 ? 2 : 1);
}
