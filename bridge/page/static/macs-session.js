/**
 * What a headset and its gateway know of each other over several connections (docs/protocol.md, Sessions). Pure.
 *
 * A headset whose connection ends is asleep for its gateway: it keeps its id, its registrations, and what is said to it.
 * It comes back with the session's secret, and both tell each other how much has come, so that nothing is said twice.
 */

const MANAGERS = new Set(["SessionOpened", "SessionResumed"]);

export class Session {
  constructor() {
    this.secret = "";
    /** Messages that came, over all connections. */
    this.received = 0;
    /** Frames that were sent, likewise. */
    this.sent = 0;
    /** As many messages the gateway knows to have come. */
    this.told = 0;
    this.open = false;
    /** What was changed while it was asleep, in order: functions that give frames. */
    this.later = [];
  }

  /** What its configuration says. */
  get said() {
    return { session: this.secret, received: this.received };
  }

  /** Whether a message is of the gateway's, about sessions. */
  static isAbout(message) {
    return message.senderType === null && !message.nodeName && MANAGERS.has(message.manager);
  }

  /** Another one begins: of the one before nothing counts. */
  begin(secret) {
    this.secret = secret;
    this.received = this.told = 0;
    this.open = true;
    this.later = [];
  }

  /** There is none any more. */
  end() {
    this.secret = "";
    this.received = this.sent = this.told = 0;
    this.open = false;
    this.later = [];
  }

  /** It goes on; how many of the frames that were sent have not come. */
  goOn(frames) {
    const lost = Math.max(0, this.sent - frames);
    this.sent = frames;
    return lost;
  }
}
