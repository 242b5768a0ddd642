/**
 * Who has still to be told to stand: each robot by itself, so that one that is not there keeps nobody waiting, and not for
 * ever. Pure: the time is passed in, in ms.
 */

/** A robot that comes back later has been without its sender for so long that it stands, or goes by its own rules. */
export const DEBT_MS = 60_000;

export class Debts {
  #robots;
  /** Whether a group is owed whose robots are not known: it is paid by the gateway's next answer. */
  #some;

  constructor(robots, now) {
    this.#robots = new Set(robots);
    this.#some = robots.length === 0;
    this.until = now + DEBT_MS;
  }

  /** Robots that were not there yet. */
  get robots() {
    return [...this.#robots];
  }

  isOpen(now) {
    return (this.#some || this.#robots.size > 0) && now < this.until;
  }

  /** The gateway has answered, and these are online: which are paid now; null: nobody. */
  pay(online) {
    const paid = this.robots.filter((robot) => online.includes(robot));
    const anybody = this.#some || paid.length > 0;
    for (const robot of paid) this.#robots.delete(robot);
    this.#some = false;
    return anybody ? paid : null;
  }
}
