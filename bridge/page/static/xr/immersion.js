/** Into VR or AR and back: which there is, and whether who wears the headset is there. */

const FEATURES = { optionalFeatures: ["local-floor", "hand-tracking"] };
const MODES = ["immersive-vr", "immersive-ar"];

export class Immersion extends EventTarget {
  constructor(renderer, xr = navigator.xr) {
    super();
    this.renderer = renderer;
    this.xr = xr;
    this.session = null;
    this.modes = new Set();
  }

  /** Ask which modes there are, now and when a headset comes or goes. */
  async look() {
    const found = new Set();
    for (const mode of MODES) {
      if (await this.xr?.isSessionSupported(mode).catch(() => false)) found.add(mode);
    }
    this.modes = found;
    this.dispatchEvent(new Event("modes"));
    if (!this.listening) this.xr?.addEventListener?.("devicechange", () => this.look());
    this.listening = true;
  }

  get mode() {
    return this.session ? this.chosen : null;
  }

  /** Whether there is somebody who sees the scene and whose hands count. */
  get attended() {
    return this.session === null || this.session.visibilityState === "visible";
  }

  /** Has to be called by a press of somebody. Rejects where the browser refuses. */
  async enter(mode) {
    if (this.session) return;
    const session = await this.xr.requestSession(mode, FEATURES);
    this.session = session;
    this.chosen = mode;
    session.addEventListener("end", () => this.#ended(session));
    session.addEventListener("visibilitychange", () => this.dispatchEvent(new Event("attention")));
    try {
      await this.renderer.xr.setSession(session);
    } catch (error) {
      await session.end().catch(() => {});
      throw error;
    }
    this.dispatchEvent(new Event("entered"));
  }

  leave() {
    return this.session?.end();
  }

  #ended(session) {
    if (this.session !== session) return;
    this.session = null;
    this.dispatchEvent(new Event("left"));
  }
}
