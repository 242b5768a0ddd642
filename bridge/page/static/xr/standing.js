/** What robots say of themselves, asked again and again: who has control, how old commands may be, whether they are stopped. */

/** As many questions at a time: a browser has six connections to a gateway, for all that it asks. */
const AT_A_TIME = 3;

export class Standing {
  /** robot → what it said last; null: it was asked and did not say. */
  said = new Map();
  #robots = [];
  #target = null;
  #busy = false;
  #again = false;

  /**
   * `ask(path)` gives JSON or null; `told(robot, answer, deadman)` is called for each that answers, with what it says of the topic's
   * dead-man, or null; `done()` after each round.
   */
  constructor({ ask, told, done }) {
    this.ask = ask;
    this.told = told;
    this.done = done;
  }

  /** These robots from now on, for a topic; of them nothing is known. */
  mean(robots, topic) {
    this.#robots = robots;
    this.#target = { topic };
    this.said.clear();
  }

  /** Nothing that was said holds any more. */
  forget() {
    for (const robot of this.said.keys()) this.said.set(robot, null);
  }

  /** Ask all of them, one round at a time; `anew`: what happened just now is asked for after the round that runs. */
  async round({ anew = true } = {}) {
    if (this.#busy) {
      this.#again ||= anew;
      return;
    }
    this.#busy = true;
    try {
      do {
        this.#again = false;
        const left = [...this.#robots];
        const one = async () => {
          for (let robot = left.shift(); robot !== undefined; robot = left.shift()) await this.#one(robot);
        };
        await Promise.all(Array.from({ length: AT_A_TIME }, one));
        this.done();
      } while (this.#again);
    } finally {
      this.#busy = false;
    }
  }

  async #one(robot) {
    const target = this.#target;
    const answer = await this.ask(`/view/robots/${robot}/status`);
    if (target !== this.#target) return;
    if (!answer || answer.error) {
      this.said.set(robot, null);
      return;
    }
    const node = answer.nodes?.find((each) => each.name === target.topic && (each.control || each.deadman));
    this.said.set(robot, {
      holder: node?.control?.holder ?? null,
      exclusive: Boolean(node?.control),
      secondsLeft: node?.control?.seconds_left ?? 0,
      deadmanS: node?.deadman?.silence_s ?? null,
      drops: answer.drops ?? {},
      registrants: node?.registrants ?? [],
      /** Whether it asks what time commands were made. */
      compares: typeof answer.max_timed_command_age_s === "number",
    });
    this.told(robot, answer, node?.deadman ?? null);
  }
}
