/** What robots say in kinds, told in words. Pure. */

const REFUSED = {
  too_old: "the command came too late",
  repeated: "the command came twice",
  out_of_order: "the command came behind a later one",
  no_route: "the command went nowhere",
  no_clock: "the robot does not know how late it is here",
};

/** Why who names robots by their group only has no control to take, and none to give. */
export const ONLY_BY_GROUP = "a robot gives control to who may name it by its number, and this token names groups only";

/** Why a command was not carried out: `kind` as robots name it, and what they say besides. */
export function refused(kind, reason) {
  return `${REFUSED[kind] ?? kind}: ${reason}`;
}
