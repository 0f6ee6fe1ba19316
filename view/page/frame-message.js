// Binary layout of a frame on the WebSocket, as view/_frame_message.py describes it. Little-endian, as browsers are.

const VERSION = 3;
const HEADER_BYTES = 56;
const CONTACT_BYTES = 28;
const JOINED_BYTES = 8;

/** Reads one message (ArrayBuffer). Arrays have rows * columns values, row by row, and share the message's memory. */
export function readFrame(buffer) {
  const header = new DataView(buffer);
  if (header.getUint32(0, true) !== VERSION) throw new Error("a frame of another version; reload the page");
  const rows = header.getUint16(8, true);
  const columns = header.getUint16(10, true);
  const contactCount = header.getUint16(12, true);
  const cells = rows * columns;
  const countsAt = HEADER_BYTES + 16 * cells;
  const contactsAt = countsAt + 3 * cells;
  const joinedAt = contactsAt + contactCount * CONTACT_BYTES;
  const contacts = [];
  for (let at = contactsAt; at < joinedAt; at += CONTACT_BYTES) {
    const numbers = [4, 8, 12, 16, 20, 24].map((off) => header.getFloat32(at + off, true));
    const [x_mm, y_mm, z_mm, force_n, peak_kpa, area_mm2] = numbers;
    contacts.push({ id: header.getUint32(at, true), joined: [], x_mm, y_mm, z_mm, force_n, peak_kpa, area_mm2 });
  }
  for (let at = joinedAt; at < buffer.byteLength; at += JOINED_BYTES) {
    const id = header.getUint32(at, true);
    contacts.find((contact) => contact.id === id).joined.push(header.getUint32(at + 4, true));
  }
  const reason = new Uint8Array(buffer, countsAt + 2 * cells, cells);
  return {
    number: header.getUint32(4, true),
    rows,
    columns,
    marks: header.getUint16(14, true),
    time_s: header.getFloat64(16, true),
    deviceTime_s: header.getFloat64(24, true),
    hostTime_s: header.getFloat64(32, true),
    age_s: header.getFloat64(40, true),
    pressure: new Float32Array(buffer, HEADER_BYTES, cells),
    std: new Float32Array(buffer, HEADER_BYTES + 4 * cells, cells),
    resistance: new Float32Array(buffer, HEADER_BYTES + 8 * cells, cells),
    change: new Float32Array(buffer, HEADER_BYTES + 12 * cells, cells),
    totalForce_n: header.getFloat64(48, true),
    contacts,
    counts: new Uint16Array(buffer, countsAt, cells),
    reason,
    valid: reason.map((why) => (why === 0 ? 1 : 0)),
  };
}
