// A headset that does what the conformance kit asks for, made of macs.js: for node and for browsers.

/** Begin; what is returned ends it. */
export function begin({ Headset }, url) {
  const bytes = (hex) => Uint8Array.from(hex.match(/../g), (two) => parseInt(two, 16));
  const ok = bytes("0001000001000000030000006f6b00");
  const headset = new Headset(url, { group: 3 });
  headset.subscribe("/conformance/text", "std_msgs/String", { robots: [1] });
  const command = headset.advertise("/conformance/command", "std_msgs/String", { robots: [1] });
  headset.serve("/conformance/ask", "std_srvs/SetBool", { robots: [1] }, () => ok);
  headset.addEventListener("link", ({ detail }) => {
    if (!detail.up) return;
    headset.call("/conformance/set", "std_srvs/SetBool", 1, bytes("0001000001")).catch(() => {});
    command.publish(bytes("000100000600000068656c6c6f00"));
    headset.online().catch(() => {});
  });
  headset.keepConnecting();
  return () => headset.close();
}
