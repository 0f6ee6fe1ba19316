// The texts beside the heat map: the cell under the pointer, contacts, rest, and the link.

import { fixed, ids, milliseconds, newtons, ohm } from "./numbers.js";

const MOST_CONTACTS = 8;

export const element = (id) => document.getElementById(id);

/** Text of an element, written only when it has changed. */
export function write(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

/** Shows one cell of a frame; null: none is pointed at. `reasons`: why a cell is not valid, by number. */
export function showCell(frame, index, reasons) {
  element("cell").hidden = index === null;
  element("cell-hint").hidden = index !== null;
  if (index === null) return;
  const valid = frame.valid[index] === 1;
  write(element("cell-place"), `${Math.floor(index / frame.columns)}, ${index % frame.columns}`);
  write(element("cell-pressure"), `${fixed(frame.pressure[index], 3)} kPa${valid ? "" : " (kept)"}`);
  write(element("cell-std"), `± ${fixed(frame.std[index], 3)} kPa`);
  write(element("cell-resistance"), ohm(frame.resistance[index]));
  write(element("cell-counts"), String(frame.counts[index]));
  write(element("cell-change"), fixed(frame.change[index], 1));
  write(element("cell-valid"), valid ? "valid" : `not valid: ${reasons[frame.reason[index]] ?? "unknown"}`);
  element("cell-valid").classList.toggle("invalid", !valid);
}

/** Shows the contacts of a frame, the largest force first. */
export function showContacts(all) {
  const contacts = all.slice(0, MOST_CONTACTS);
  const more = all.length - contacts.length;
  const body = element("contacts").tBodies[0];
  element("contacts").hidden = contacts.length === 0;
  element("no-contacts").hidden = contacts.length > 0 && more === 0;
  write(element("no-contacts"), more ? `and ${more} with less force` : "Nothing touches the skin.");
  while (body.rows.length > contacts.length) body.deleteRow(-1);
  while (body.rows.length < contacts.length) {
    const row = body.insertRow();
    for (let k = 0; k < 5; k++) row.insertCell();
  }
  contacts.forEach((contact, k) => {
    const texts = [
      ids(contact),
      newtons(contact),
      fixed(contact.peak_kpa, 1),
      [contact.x_mm, contact.y_mm, contact.z_mm].filter(Number.isFinite).map((mm) => fixed(mm, 1)).join(", "),
      fixed(contact.area_mm2, 0),
    ];
    texts.forEach((text, at) => write(body.rows[k].cells[at], text));
  });
}

/** Shows pairs of a name and a text in a list of definitions. */
export function showPairs(list, pairs) {
  while (list.children.length > 2 * pairs.length) list.lastElementChild.remove();
  while (list.children.length < 2 * pairs.length) {
    list.append(document.createElement("dt"), document.createElement("dd"));
  }
  pairs.forEach(([name, text], k) => {
    write(list.children[2 * k], name);
    write(list.children[2 * k + 1], text);
  });
}

/** How many cells are not valid, by reason. */
function notValid(frame, reasons) {
  const counts = new Map();
  const none = reasons.indexOf("no cell");
  for (const reason of frame?.reason ?? []) if (reason && reason !== none) counts.set(reason, (counts.get(reason) ?? 0) + 1);
  const texts = [...counts].sort((one, other) => other[1] - one[1]).map(([reason, n]) => `${n} ${reasons[reason] ?? "unknown"}`);
  return texts.join(", ") || "none";
}

/** Rows of the link's panel: of the board, of the line, and of this page. */
export function linkPairs(introduction, status, cost, frame) {
  const found = status.statistics;
  const board = [
    ["board", [introduction.board, introduction.serial_number].filter(Boolean).join(" ")],
    ...(introduction.estimator ? [["estimator", introduction.estimator]] : []),
    ["not valid", notValid(frame, introduction.reasons)],
  ];
  const line = [
    ["rate", `${fixed(found.rate_hz, 1)} Hz`],
    ["frames", String(found.frames)],
    ["lost", found.lost === null ? "not known" : String(found.lost)],
    ["skipped", String(found.skipped)],
    ["corrupt", found.why_corrupt ? `${found.corrupt} (${found.why_corrupt})` : String(found.corrupt)],
    ["reconnects", String(found.reconnects)],
    ["reboots", String(found.reboots)],
    ["unsolved", String(found.unsolved)],
  ];
  const ages = ["50", "95", "99"].map((percent) => milliseconds(found.age_s[percent]));
  const age = introduction.live ? [["age 50, 95, 99 %", `${ages.join(", ")} ms`]] : [];
  return [...board, ...line, ...age, ["drawn", `${fixed(cost.perSecond, 0)} /s, ${fixed(cost.mean_ms, 2)} ms`]];
}

const STATES = {
  running: ["live", "good"],
  silent: ["silent", "warning"],
  away: ["away, reconnecting", "warning"],
  ended: ["ended", ""],
  lost: ["lost", "bad"],
  decoding: ["decoding", "warning"],
  recording: ["recording", "good"],
};

/** Shows the state of the link; `state` is a key of STATES, or a text of its own for a broken connection. */
export function showState(state, reason) {
  const [text, kind] = STATES[state] ?? [state, "bad"];
  write(element("state"), text);
  element("state").className = `state ${kind}`;
  element("notice").hidden = reason === "";
  write(element("notice"), reason);
}
