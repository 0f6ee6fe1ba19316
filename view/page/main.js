// The page of `ohmskin view`: frames come in over a WebSocket, and are drawn when the browser is about to paint.

import { themeColours } from "./canvas.js";
import { Connection } from "./connection.js";
import { readFrame } from "./frame-message.js";
import { HeatMap } from "./heat-map.js";
import { History, Series, Steady } from "./history.js";
import { fixed } from "./numbers.js";
import { element, linkPairs, showCell, showContacts, showPairs, showState, write } from "./panels.js";
import { drawPlot, timeAt } from "./plot.js";
import { ShapeMap } from "./shape-map.js";
import { drawHatching, drawScale } from "./scale.js";
import { Transport } from "./transport.js";

const MOST_CHOSEN = 6;
const PLOT_EVERY_MS = 50;
const TEXT_EVERY_MS = 100;
const TRACE_EVERY_MS = 2000; // while a recording is still being decoded
const PLOTTED_S = 30;
const TRACE_POINTS = 3000;
const THEMES = ["system", "light", "dark"];
const MAP_SHARE = 0.62; // of the page's width, at most
const BELOW_MAP = 84; // CSS pixels for the legend and the margins below the map
const TRANSPORT = 84; // and for the controls of a recording
const ZOOMS = [0.5, 0.7, 1, 1.4, 2, 2.8, 4];
const LEAST_SCALE = 0.02; // of the full scale: an automatic scale ends no lower, so that noise stays dark
const SCALE_FADES_S = 10; // an automatic scale forgets a peak in that time

/** What the heat map can show: unit, values of a frame, and the upper end of the fixed scale (null: none). */
const QUANTITIES = {
  pressure: { label: "pressure", unit: "kPa", values: (frame) => frame.pressure, fullScale: (skin) => skin.full_scale_kpa },
  std: { label: "standard deviation", unit: "kPa", values: (frame) => frame.std, fullScale: () => null },
  resistance: { label: "resistance", unit: "Ω", values: (frame) => frame.resistance, fullScale: () => null },
  change: { label: "counts above rest", unit: "", values: (frame) => frame.change, fullScale: (skin) => skin.full_scale_counts },
  counts: { label: "counts", unit: "", values: (frame) => frame.counts, fullScale: (skin) => skin.full_scale_counts },
};

class View {
  constructor() {
    this.skin = null; // what the server says of the skin
    this.status = null;
    this.frame = null; // shown
    this.arrived = null; // newest, not yet drawn
    this.asked = false; // for a newer frame
    this.paused = false;
    this.pointed = null; // index of the cell under the pointer
    this.total = new Series(); // total force over time
    this.chosen = []; // plotted cells: {index, slot, series}
    this.scale = [0, 1];
    this.drawn = 0; // frames since the page was loaded
    this.drawn_ms = 0; // time spent on them
    this.cost = { perSecond: NaN, mean_ms: NaN };
    this.spent = { frames: 0, ms: 0, since: performance.now() };
    this.last = { plot: 0, text: 0, trace: 0 };
    this.painting = false;
    this.canvases = ["map", "cells", "marks"].map(element);
    this.map = new HeatMap(...this.canvases);
    this.transport = new Transport(
      (order) => this.connection.order(order),
      () => this.paintSoon(),
    );
    this.connection = new Connection({
      reported: (message) => this.hear(message),
      framed: (buffer) => this.take(readFrame(buffer)),
      opened: () => (this.asked = false),
      broke: () => showState("no connection", "ohmskin does not answer; trying again"),
    });
    this.listen();
    this.useTheme();
  }

  /** Takes a message that is not a frame. */
  hear(message) {
    if (message.kind === "handshake") this.meet(message);
    else if (message.kind === "status") this.learn(message);
    else if (message.kind === "trace") this.plotTraces(message.traces);
    else if (message.kind === "tared") this.answerTare(message.text, message.remarks, false);
    else if (message.kind === "refused") this.refused(message);
  }

  /** Takes the handshake: what the skin is. */
  meet(skin) {
    const same = this.skin && this.skin.source === skin.source && this.skin.rows === skin.rows && this.skin.columns === skin.columns;
    this.skin = skin;
    const size = skin.cells ? `${skin.cells.index.length} cells` : `${skin.rows} × ${skin.columns}`;
    write(element("source"), `${skin.source} · ${size}`);
    document.title = `${skin.source} · ohmskin`;
    element("record").hidden = element("pause").hidden = element("rest").hidden = !skin.live;
    element("transport").hidden = skin.live;
    if (!same) {
      this.history = new History(skin.rows * skin.columns, skin.circuit === null);
      document.body.classList.toggle("in-counts", skin.circuit === null);
      this.chosen = [];
      this.total = new Series();
      this.offerQuantities();
      this.map.leave();
      this.map = skin.cells ? new ShapeMap(...this.canvases, skin.cells, () => this.layOut()) : new HeatMap(...this.canvases);
      element("axes").closest("label").hidden = skin.cells !== null;
      this.layOut();
      this.listChosen();
    }
    if (skin.live) this.askNext(-1);
    else this.transport.restart();
  }

  /** Takes the state of the link. */
  learn(status) {
    this.status = status;
    showState(status.state, status.state === "running" ? "" : status.reason);
    if (this.skin.live) {
      this.showTare();
      this.showRecording();
    }
    else this.transport.learn(status);
    showPairs(element("link"), linkPairs(this.skin, status, this.cost, this.frame));
    if (status.state === "decoding") this.askTraces();
    else if (!this.skin.live && !this.traced) {
      this.traced = true;
      this.askTraces(true);
    }
    this.paintSoon();
  }

  /** Takes a frame. The next one is asked for at once, unless this page is behind with drawing. */
  take(frame) {
    this.asked = false;
    const behind = this.arrived !== null;
    this.arrived = frame;
    if (this.skin.live) {
      this.history.add(frame);
      this.total.add(frame.time_s, frame.totalForce_n, NaN);
      for (const { index, series } of this.chosen) {
        const plotted = this.skin.circuit === null ? frame.change : frame.pressure;
        series.add(frame.time_s, frame.valid[index] ? plotted[index] : NaN, frame.std[index]);
      }
      if (!behind) this.askNext(frame.number);
    } else {
      this.transport.arrived(frame);
    }
    this.paintSoon();
  }

  askNext(after) {
    if (this.asked || this.paused) return;
    this.asked = true;
    this.connection.order({ do: "next", after });
  }

  paintSoon() {
    if (this.painting) return;
    this.painting = true;
    requestAnimationFrame((now) => this.paint(now));
  }

  /** Draws what is new. Called once before the browser paints. */
  paint(now) {
    this.painting = false;
    const started = performance.now();
    const fresh = this.arrived !== null;
    if (fresh && !this.paused) {
      this.frame = this.arrived;
      this.arrived = null;
      this.drawn++;
    }
    if (this.frame && this.map.rows) this.draw(now);
    if (fresh) this.count(started);
    if (this.skin?.live) {
      if (this.frame && !this.asked) this.askNext(this.frame.number);
    } else {
      this.transport.advance();
    }
  }

  draw(now) {
    const { frame } = this;
    const quantity = QUANTITIES[element("quantity").value];
    const values = quantity.values(frame);
    this.drawScaleFor(quantity, values);
    if (this.skin.live && !this.paused) {
      if (this.steady?.quantity !== quantity || this.steady.values.length !== values.length) this.steady = new Steady(values.length, quantity);
      this.steady.take(values, frame.valid, now);
      this.map.drawCells(this.steady.values, this.steady.shown, ...this.scale);
    } else {
      this.map.drawCells(values, frame.valid, ...this.scale);
    }
    const chosen = this.chosen.map(({ index, slot }) => ({ index, colour: this.colours.series[slot] }));
    this.map.drawMarks(frame, this.skin.pitch_mm, chosen, this.pointed);
    showContacts(frame.contacts);
    document.body.classList.toggle("alarm", this.alarms());
    if (now - this.last.plot >= PLOT_EVERY_MS || this.hurry) {
      this.last.plot = now;
      this.drawPlot();
    }
    if (now - this.last.text >= TEXT_EVERY_MS || this.hurry) {
      this.last.text = now;
      showCell(frame, this.pointed, this.skin.reasons);
      write(element("total"), `${fixed(frame.totalForce_n, 2)} N`);
    } else {
      this.textLater();
    }
    this.hurry = false;
  }

  /** The last frame's text is written even if no other frame comes. */
  textLater() {
    if (this.timer) return;
    this.timer = setTimeout(() => {
      this.timer = null;
      this.refresh();
    }, TEXT_EVERY_MS);
  }

  /** Draws all again, the texts included. */
  refresh() {
    this.hurry = true;
    this.paintSoon();
  }

  count(started) {
    const { spent } = this;
    const now = performance.now();
    spent.frames++;
    spent.ms += now - started;
    this.drawn_ms += now - started;
    if (now - spent.since < 1000) return;
    this.cost = { perSecond: (1e3 * spent.frames) / (now - spent.since), mean_ms: spent.ms / spent.frames };
    this.spent = { frames: 0, ms: 0, since: now };
  }

  /** Chooses the scale for the values, and draws it where it has changed. */
  drawScaleFor(quantity, values) {
    const scale = this.scaleFor(quantity, values);
    const key = [quantity.unit, ...scale, this.legendWidth].join();
    if (key === this.scaleKey) return;
    this.scaleKey = key;
    this.scale = scale;
    drawScale(element("scale"), this.legendWidth, ...scale, quantity.unit, this.colours);
  }

  /** The ends of the scale: full, of the present values, or from 0 to the largest value of late. */
  scaleFor(quantity, values) {
    const full = quantity.fullScale(this.skin);
    const choice = element("range").value;
    const present = rangeOf(values, this.frame.valid);
    if (choice === "present" || full === null) return present;
    if (choice === "full") return [0, full];
    const since_s = Math.max(this.frame.time_s - (this.peak?.time_s ?? 0), 0);
    const before = this.peak?.unit === quantity.label ? this.peak.value * Math.exp(-since_s / SCALE_FADES_S) : 0;
    const value = Math.min(Math.max(present[1], before, LEAST_SCALE * full), full);
    this.peak = { value, time_s: this.frame.time_s, unit: quantity.label };
    // In steps, so that the scale's numbers stand still.
    const step = 10 ** Math.floor(Math.log10(value));
    return [0, Math.min([1, 1.5, 2, 3, 5, 7, 10].find((times) => times * step >= value) * step, full)];
  }

  /** Whether a valid cell, or the total force where that is plotted, is above the threshold. */
  alarms() {
    const threshold = element("threshold").valueAsNumber;
    if (!(threshold > 0)) return false;
    if (this.plotsForce) return this.frame.totalForce_n > threshold;
    const values = this.skin.circuit === null ? this.frame.change : this.frame.pressure;
    return values.some((value, k) => this.frame.valid[k] && value > threshold);
  }

  drawPlot() {
    const ofCells = this.chosen.map(({ slot, series }) => ({ series, colour: this.colours.series[slot] }));
    const lines = this.plotsForce ? [{ series: this.total, colour: this.colours.accent }] : ofCells;
    drawPlot(element("plot"), lines, this.plotView(), this.colours);
  }

  plotView() {
    const now = this.frame.time_s;
    const threshold = element("threshold").valueAsNumber;
    const ofCells = this.skin.circuit === null ? ["counts", 10] : ["kPa", 0.1 * (this.skin.full_scale_kpa ?? 1)];
    const [unit, least] = this.plotsForce ? ["N", 0.1] : ofCells;
    const shown = { unit, least, threshold: threshold > 0 ? threshold : null };
    if (this.skin.live) return { from: now - PLOTTED_S, to: now, origin: now, cursor: null, gaps: true, ...shown };
    return { from: 0, to: Math.max(this.transport.seconds, 1e-3), origin: 0, cursor: now, gaps: false, ...shown };
  }

  get plotsForce() {
    return element("plotted").value === "force";
  }

  /** Adds a cell to the plot, or takes it away. */
  choose(index) {
    const already = this.chosen.findIndex((one) => one.index === index);
    if (already >= 0) this.chosen.splice(already, 1);
    else {
      if (this.chosen.length === MOST_CHOSEN) this.chosen.shift();
      const taken = new Set(this.chosen.map((one) => one.slot));
      const slot = [0, 1, 2, 3, 4, 5].find((free) => !taken.has(free));
      this.chosen.push({ index, slot, series: this.skin.live ? this.history.series(index) : new Series() });
    }
    this.listChosen();
    this.askTraces(true);
    this.refresh();
  }

  listChosen() {
    const buttons = this.chosen.map(({ index, slot }) => {
      const button = document.createElement("button");
      const swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.style.background = `var(--series-${slot})`;
      const place = `${Math.floor(index / this.skin.columns)}, ${index % this.skin.columns}`;
      button.append(swatch, `cell ${place}  ×`);
      button.ariaLabel = `Take cell ${place} off the plot`;
      button.addEventListener("click", () => this.choose(index));
      return button;
    });
    const what = this.skin.circuit === null ? "counts" : "pressure";
    const band = this.skin.circuit === null ? "counts above rest" : "band: ± 1 standard deviation";
    const hint = this.chosen.length ? band : `Click cells of the map to plot their ${what}.`;
    const force = "pressure times area, over all valid cells";
    element("chosen").replaceChildren(...(this.plotsForce ? [force] : [...buttons, hint]));
  }

  askTraces(now = false) {
    if (!this.skin || this.skin.live || !(this.chosen.length || this.plotsForce)) return;
    const moment = performance.now();
    if (!now && moment - this.last.trace < TRACE_EVERY_MS) return;
    this.last.trace = moment;
    const cells = this.chosen.map(({ index }) => [Math.floor(index / this.skin.columns), index % this.skin.columns]);
    this.connection.order({ do: "trace", cells, points: TRACE_POINTS, total: this.plotsForce });
  }

  plotTraces(traces) {
    for (const trace of traces) {
      if (trace.cell === null) {
        this.total = Series.of(trace);
        continue;
      }
      const index = trace.cell[0] * this.skin.columns + trace.cell[1];
      const one = this.chosen.find((cell) => cell.index === index);
      if (one) one.series = Series.of(trace);
    }
    this.refresh();
  }

  showTare() {
    const { tare, undoable } = this.status;
    const untared =
      this.skin.circuit === null ? "No circuit is known: counts as they come." : "Rest resistances are those of the data sheet.";
    const text = tare === null ? untared : `Tared over ${tare.frames} frames.`;
    write(element("tare-state"), text);
    element("undo").hidden = !undoable;
  }

  showRecording() {
    const { records, recorded } = this.status;
    element("record").ariaPressed = String(records);
    write(element("record"), records ? "Stop recording" : "Record");
    write(element("recorded"), recorded && (records ? `to ${recorded}` : `recorded ${recorded}`));
  }

  orderTare(force) {
    element("tare").disabled = true;
    element("tare-anyway").hidden = true;
    write(element("tare-answer"), "taring …");
    this.connection.order({ do: "tare", force });
  }

  answerTare(text, remarks, forceable) {
    element("tare").disabled = false;
    element("tare-anyway").hidden = !forceable;
    write(element("tare-answer"), remarks.length ? `${text}, although ${remarks.join("; ")}` : text);
  }

  refused({ text, order }) {
    if (order === "tare" || order === "undo tare") {
      this.answerTare(text, [], order === "tare" && text.includes("seems to be loaded"));
    } else if (order === "record") {
      write(element("recorded"), text);
    } else if (order === "trace") {
      setTimeout(() => this.askTraces(true), 200);
    } else if (order.startsWith("show")) {
      this.transport.refused();
    }
  }

  pause() {
    this.paused = !this.paused;
    element("pause").ariaPressed = String(this.paused);
    write(element("pause"), this.paused ? "Paused" : "Pause");
    this.refresh();
  }

  offerQuantities() {
    const { circuit, full_scale_kpa } = this.skin;
    const inCounts = ["change", "counts"];
    const inOhms = full_scale_kpa === null ? ["resistance", "counts"] : ["pressure", "std", "resistance", "counts"];
    const known = circuit === null ? inCounts : inOhms;
    element("quantity").replaceChildren(...known.map((name) => new Option(QUANTITIES[name].label, name)));
    // The numbers of a board that nobody has described may use a small part of their range.
    if (circuit === null) element("range").value = "present";
  }

  /** Lays everything out for the room that the window has. */
  layOut() {
    if (!this.skin) return;
    const holder = element("map").closest("section");
    const style = getComputedStyle(holder);
    const padding = parseFloat(style.paddingLeft) + parseFloat(style.paddingRight);
    const narrow = globalThis.innerWidth <= 960;
    const room = narrow ? holder.clientWidth : MAP_SHARE * holder.parentElement.clientWidth;
    const below = element("transport").hidden ? BELOW_MAP : BELOW_MAP + TRANSPORT;
    const above = element("map").getBoundingClientRect().top + globalThis.scrollY;
    const width = room - padding;
    const height = narrow ? 1.25 * width : Math.max(globalThis.innerHeight - above - below, 300);
    const pitch_mm = element("axes").value === "mm" ? this.skin.pitch_mm : null;
    const zoom = ZOOMS[Number(stored("zoom", "2"))] ?? 1;
    holder.parentElement.style.setProperty("--room", `${width}px`);
    this.map.layOut(this.skin.rows, this.skin.columns, zoom * width, zoom * height, this.colours, { ...this.orientation, pitch_mm });
    this.legendWidth = Math.min(width - 100, this.map.cells.width / this.map.ratio - 100, 480);
    this.legendWidth = Math.max(this.legendWidth, 160);
    this.scaleKey = "";
    drawHatching(element("hatching"), this.colours);
    this.refresh();
  }

  useTheme() {
    const wish = stored("theme", "system");
    const dark = wish === "dark" || (wish === "system" && matchMedia("(prefers-color-scheme: dark)").matches);
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    write(element("theme"), { system: "Theme: system", light: "Theme: light", dark: "Theme: dark" }[wish]);
    this.colours = themeColours();
    this.layOut();
  }

  listen() {
    element("theme").addEventListener("click", () => {
      store("theme", THEMES[(THEMES.indexOf(stored("theme", "system")) + 1) % THEMES.length]);
      this.useTheme();
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.useTheme());
    addEventListener("resize", () => this.layOut());
    element("pause").addEventListener("click", () => this.pause());
    element("quantity").addEventListener("change", () => this.refresh());
    element("range").addEventListener("change", () => this.refresh());
    element("record").addEventListener("click", () => this.connection.order({ do: "record", on: !this.status.records }));
    element("tare").addEventListener("click", () => this.orderTare(false));
    element("tare-anyway").addEventListener("click", () => this.orderTare(true));
    element("undo").addEventListener("click", () => this.connection.order({ do: "undo tare" }));
    this.listenToMap();
    this.listenToTools();
    element("plot").addEventListener("click", (event) => {
      if (!this.frame || this.skin.live) return;
      const time_s = timeAt(element("plot"), event, this.plotView());
      if (time_s !== null) this.transport.seek(time_s);
    });
  }

  /** Orientation, axes, the plot's kind and threshold, and what can be saved. */
  listenToTools() {
    this.orientation = { turns: Number(stored("turns", "0")) % 4, mirrored: stored("mirrored", "no") === "yes" };
    element("axes").value = stored("axes", "cells");
    const turn = (change) => {
      Object.assign(this.orientation, change);
      store("turns", String(this.orientation.turns));
      store("mirrored", this.orientation.mirrored ? "yes" : "no");
      this.layOut();
    };
    const zoomBy = (steps) => {
      store("zoom", String(Math.min(Math.max(Number(stored("zoom", "2")) + steps, 0), ZOOMS.length - 1)));
      this.layOut();
    };
    element("zoom-in").addEventListener("click", () => zoomBy(1));
    element("zoom-out").addEventListener("click", () => zoomBy(-1));
    element("rotate").addEventListener("click", () => turn({ turns: (this.orientation.turns + 1) % 4 }));
    element("mirror").addEventListener("click", () => turn({ mirrored: !this.orientation.mirrored }));
    element("axes").addEventListener("change", () => {
      store("axes", element("axes").value);
      this.layOut();
    });
    element("plotted").addEventListener("change", () => {
      this.listChosen();
      this.askTraces(true);
      this.refresh();
    });
    element("threshold").addEventListener("input", () => this.refresh());
    element("picture").addEventListener("click", () => {
      this.map.picture().toBlob((blob) => save(blob, `${this.fileStem()}.png`));
    });
    element("numbers").addEventListener("click", () => {
      save(new Blob([frameTable(this.frame, this.skin.cells?.index)], { type: "text/csv" }), `${this.fileStem()}.csv`);
    });
  }

  fileStem() {
    const source = this.skin.source.replace(/[^\w.-]+/g, "-").replace(/^-+|-+$/g, "");
    return `${source || "skin"}-${this.frame.number}`;
  }

  listenToMap() {
    const map = element("map");
    const point = (index) => {
      if (index === this.pointed) return;
      this.pointed = index;
      this.refresh();
    };
    map.addEventListener("pointermove", (event) => point(this.map.cellAt(event)));
    map.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && point(null));
    map.addEventListener("click", (event) => {
      if (this.map.hasTurned()) return;
      const index = this.map.cellAt(event);
      point(index);
      if (index !== null) this.choose(index);
    });
    map.addEventListener("keydown", (event) => {
      const ways = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
      if (event.key in ways) {
        const [down, along] = ways[event.key];
        point(this.map.step(this.pointed, down, along));
      } else if ((event.key === "Enter" || event.key === " ") && this.pointed !== null) this.choose(this.pointed);
      else return;
      event.preventDefault();
    });
  }
}

/** All numbers of a frame as CSV, one line per cell that there is (null: at every crossing). */
function frameTable(frame, there) {
  const number = (value) => (Number.isFinite(value) ? String(value) : "");
  const lines = ["row,column,pressure_kpa,std_kpa,resistance_ohm,counts,valid"];
  for (const k of there ?? frame.counts.keys()) {
    const place = [Math.floor(k / frame.columns), k % frame.columns];
    const values = [frame.pressure[k], frame.std[k], frame.resistance[k]].map(number);
    lines.push([...place, ...values, frame.counts[k], frame.valid[k]].join(","));
  }
  return `${lines.join("\n")}\n`;
}

/** Hands a file to the browser. */
function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Least and largest of the valid values, a little apart. */
function rangeOf(values, valid) {
  let [low, high] = [Infinity, -Infinity];
  for (let k = 0; k < values.length; k++) {
    if (!valid[k] || !Number.isFinite(values[k])) continue;
    if (values[k] < low) low = values[k];
    if (values[k] > high) high = values[k];
  }
  if (low > high) return [0, 1];
  const room = Math.max(high - low, 1e-3 * Math.abs(high), 1e-6);
  return [low, low + room];
}

function stored(key, usual) {
  try {
    return localStorage.getItem(`ohmskin-${key}`) ?? usual;
  } catch {
    return usual; // a browser that keeps nothing
  }
}

function store(key, value) {
  try {
    localStorage.setItem(`ohmskin-${key}`, value);
  } catch {
    // as above: the switch then works until the page is loaded anew
  }
}

/** For the browser's console, and for tests. */
globalThis.ohmskin = new View();
