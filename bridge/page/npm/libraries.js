// What the page uses of others, bundled into one file.
export { default as uPlot } from "uplot";
export { parse } from "@foxglove/rosmsg";
export { MessageReader, MessageWriter } from "@foxglove/rosmsg2-serialization";
