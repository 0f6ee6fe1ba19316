// The WebSocket to ohmskin: opened again when it breaks, with a longer pause each time.

const FIRST_PAUSE_MS = 250;
const LONGEST_PAUSE_MS = 4000;

export class Connection {
  /** @param handlers {reported(object), framed(ArrayBuffer), opened(), broke()} */
  constructor(handlers) {
    this.handlers = handlers;
    this.pause_ms = FIRST_PAUSE_MS;
    this.open();
  }

  open() {
    const address = new URL("frames", document.baseURI);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    address.search = address.hash = "";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.addEventListener("open", () => {
      this.pause_ms = FIRST_PAUSE_MS;
      this.handlers.opened();
    });
    this.socket.addEventListener("message", ({ data }) => {
      if (data instanceof ArrayBuffer) this.handlers.framed(data);
      else this.handlers.reported(JSON.parse(data));
    });
    this.socket.addEventListener("close", () => {
      this.handlers.broke();
      setTimeout(() => this.open(), this.pause_ms);
      this.pause_ms = Math.min(2 * this.pause_ms, LONGEST_PAUSE_MS);
    });
  }

  /** Sends an order, as view/_orders.py has them; it is dropped while the connection is broken. */
  order(order) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(order));
  }
}
