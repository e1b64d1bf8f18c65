// The websocket: connects, connects again, passes on what came.

const FIRST_WAIT_MS = 100;
const LONGEST_WAIT_MS = 1000;
const CONNECT_MS = 3000;
const SILENT_MS = 1700; // the server sends twice a second

export class Feed {
  /** `told(message)` for texts, `sampled(DataView)` for samples, `changed(open)` for the line. */
  constructor({ told, sampled, changed }) {
    Object.assign(this, { told, sampled, changed });
    this.open = false;
    this.opened = 0; // times
    this.wait = FIRST_WAIT_MS;
    this.heard = 0;
    setInterval(() => this.#watch(), 200);
    this.#connect();
  }

  send(command) {
    if (this.open) this.socket.send(JSON.stringify(command));
    return this.open;
  }

  #connect() {
    const address = new URL("live", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.heard = performance.now();
    this.open = false;
    socket.onopen = () => {
      if (socket !== this.socket) return;
      this.open = true;
      this.opened++;
      this.wait = FIRST_WAIT_MS;
      this.heard = performance.now();
      this.changed(true);
    };
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      this.heard = performance.now();
      if (typeof data === "string") this.told(JSON.parse(data));
      else this.sampled(new DataView(data));
    };
    socket.onclose = () => this.#lose(socket);
  }

  /** A line can be dead without having been closed. */
  #watch() {
    if (!this.socket) return;
    const silent = performance.now() - this.heard;
    if (silent > (this.open ? SILENT_MS : CONNECT_MS)) {
      const socket = this.socket;
      this.#lose(socket);
      socket.close();
    }
  }

  #lose(socket) {
    if (socket !== this.socket) return;
    this.socket = null;
    this.open = false;
    this.changed(false);
    setTimeout(() => this.#connect(), this.wait);
    this.wait = Math.min(2 * this.wait, LONGEST_WAIT_MS);
  }
}
