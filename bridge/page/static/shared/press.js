/** A combination of buttons or fingers, read again and again: when it is pressed. Pure. */
export class Press {
  /** Who comes with it pressed has pressed nothing. */
  #down = true;

  /** Whether it has just been pressed; `down` is how it is now. */
  read(down) {
    const begins = down && !this.#down;
    this.#down = down;
    return begins;
  }
}
