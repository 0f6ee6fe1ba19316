// What the page remembers of the frames it has got: some seconds of all cells, and longer of the cells that are plotted.

const MOST_BYTES = 24e6;
const MOST_FRAMES = 1800;
const SERIES_SAMPLES = 8192;

/** Ring buffer of the last frames of a skin with so many cells. */
export class History {
  /** inCounts: keep counts above rest in place of pressures, for a board whose circuit is not known */
  constructor(cells, inCounts) {
    this.cells = cells;
    this.inCounts = inCounts;
    this.capacity = Math.max(Math.min(MOST_FRAMES, Math.floor(MOST_BYTES / (8 * cells))), 2);
    this.times = new Float64Array(this.capacity);
    this.pressure = new Float32Array(this.capacity * cells);
    this.std = new Float32Array(this.capacity * cells);
    this.count = 0;
  }

  add(frame) {
    const slot = this.count % this.capacity;
    this.times[slot] = frame.time_s;
    this.pressure.set(this.inCounts ? frame.change : frame.pressure, slot * this.cells);
    this.std.set(frame.std, slot * this.cells);
    for (let k = 0; k < this.cells; k++) if (!frame.valid[k]) this.pressure[slot * this.cells + k] = NaN;
    this.count++;
  }

  /** The past of one cell as a new series. */
  series(index) {
    const series = new Series();
    const first = Math.max(this.count - this.capacity, 0);
    for (let k = first; k < this.count; k++) {
      const slot = k % this.capacity;
      const at = slot * this.cells + index;
      series.add(this.times[slot], this.pressure[at], this.std[at]);
    }
    return series;
  }
}

/** Times, pressures and standard deviations of one cell: a ring buffer. NaN where the cell was not valid. */
export class Series {
  constructor() {
    this.times = new Float64Array(SERIES_SAMPLES);
    this.pressure = new Float32Array(SERIES_SAMPLES);
    this.std = new Float32Array(SERIES_SAMPLES);
    this.count = 0;
  }

  static of(trace) {
    const missing = (value) => (value === null ? NaN : value);
    return {
      length: trace.time_s.length,
      at: trace.force_n
        ? (k) => [trace.time_s[k], missing(trace.force_n[k]), NaN]
        : (k) => [trace.time_s[k], missing(trace.pressure_kpa[k]), missing(trace.std_kpa[k])],
    };
  }

  add(time_s, pressure, std) {
    const slot = this.count % SERIES_SAMPLES;
    this.times[slot] = time_s;
    this.pressure[slot] = pressure;
    this.std[slot] = std;
    this.count++;
  }

  get length() {
    return Math.min(this.count, SERIES_SAMPLES);
  }

  /** Sample k from the oldest that is kept: [time, pressure, std]. */
  at(k) {
    const slot = (Math.max(this.count - SERIES_SAMPLES, 0) + k) % SERIES_SAMPLES;
    return [this.times[slot], this.pressure[slot], this.std[slot]];
  }
}

const KEPT_MS = 300;

/** What is drawn of each cell: one that is not valid for a moment keeps its last value, so that columns do not flicker. */
export class Steady {
  constructor(cells, quantity) {
    this.quantity = quantity; // whose values are kept
    this.values = new Float64Array(cells);
    this.shown = new Uint8Array(cells);
    this.validAt = new Float64Array(cells).fill(-Infinity);
  }

  take(values, valid, now) {
    for (let k = 0; k < values.length; k++) {
      if (valid[k]) this.validAt[k] = now;
      this.shown[k] = now - this.validAt[k] < KEPT_MS;
      if (valid[k] || !this.shown[k]) this.values[k] = values[k];
    }
  }
}
