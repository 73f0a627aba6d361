// How sharp a moving picture may be, and how much of a resting one is drawn at a time, from how long the last ones took.
// A graphics card draws all at once, and with every frame; a processor draws a picture when the one before is done.

function makePace(isSoftware) {
  const [least, quick, slow] = isSoftware ? [0.2, 0.07, 0.11] : [0.35, 1 / 45, 1 / 22], TURN = 0.08;
  const parts = { direct: 2000, mask: 100, mirrored: 4000 };
  let scale = isSoftware ? 0.35 : 1, mean = null;

  // Between quick and slow nothing changes, so that pictures do not flicker.
  function took(seconds) {
    const held = Math.min(seconds, 0.5);
    mean = mean === null ? held : mean + 0.3 * (held - mean);
    if (mean >= quick && mean <= slow) return;
    scale = clamped(scale * clamped(Math.sqrt((0.5 * (quick + slow)) / mean), 0.9, 1.05), least, 1);
  }

  return {
    took, scale: () => scale,
    most: isSoftware ? (which) => parts[which] : () => Infinity,
    drew: (which, seconds) => { parts[which] = Math.round(clamped(parts[which] * clamped(TURN / seconds, 0.5, 2), 50, 1e6)); },
  };
}
