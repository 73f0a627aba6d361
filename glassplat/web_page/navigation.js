// Where the camera is: turns about a point that it looks at, moves, snaps to photographs, and stays near them.

const EASE = (t) => t * t * (3 - 2 * t);
const IS_STILL = matchMedia('(prefers-reduced-motion: reduce)').matches, FLIGHT_SECONDS = IS_STILL ? 1e-3 : 0.9;
const LEAST_SHOWN = 0.05;  // Share of a photograph that a pane fills where it is worth a stop.

function makeNavigation(scene, changed) {
  const { views, up, focus, reach } = scene;
  const steepest = 0.35;  // radians between the line of sight and the vertical, unless a photograph is steeper
  let pose, pivot, stop, flight = null, drift = null;
  const velocity = { yaw: 0, pitch: 0 };

  const poseOf = (view) => poseAt(view.rotation, view.position);
  const forward = () => row(pose.rotation, 2);
  const sight = () => Math.max(norm(minus(pivot, centerOf(pose))), 1e-3 * reach);

  function pivotOf(view) {
    const ahead = row(view.rotation, 2), depth = dot(minus(focus, view.position), ahead);
    return plus(view.position, ahead, Math.max(depth, 0.2 * reach));
  }

  function set(next, target) {
    pose = next;
    pivot = target;
    changed();
  }

  // The nearest place that is no further from a photograph than it may be.
  function allowed(position) {
    let best = null, least = Infinity;
    for (const view of views) {
      const distance = norm(minus(position, view.position));
      if (distance < least) { least = distance; best = view.position; }
    }
    return least <= reach ? position : plus(best, unit(minus(position, best)), reach);
  }

  const isAllowed = (position) => norm(minus(allowed(position), position)) <= 1e-6 * reach;

  function moveTo(position, rotation, target) {
    const kept = allowed(position);
    set(poseAt(isAllowed(position) ? rotation : lookingAt(kept, target, levelUp(rotation)), kept), target);
  }

  // The up that keeps how the camera is rolled: that of the place, unless the camera looks along it.
  function levelUp(rotation) {
    const roll = scaled(row(rotation, 1), -1);
    return Math.abs(dot(row(rotation, 2), up)) > 0.98 ? roll : up;
  }

  function orbit(yaw, pitch) {
    const angle = Math.acos(clamped(dot(forward(), up), -1, 1));
    const held = clamped(angle + pitch, Math.min(angle, steepest), Math.max(angle, Math.PI - steepest)) - angle;
    const turn = product(rotationAbout(up, yaw), rotationAbout(row(pose.rotation, 0), -held));
    const arm = turned(turn, minus(centerOf(pose), pivot));
    moveTo(plus(pivot, arm), product(pose.rotation, transposed(turn)), pivot);
  }

  function shift(step) {
    const from = centerOf(pose), moved = allowed(plus(from, step));
    set(poseAt(pose.rotation, moved), plus(pivot, minus(moved, from)));
  }

  function pan(right, down) { shift(plus(scaled(row(pose.rotation, 0), right), row(pose.rotation, 1), down)); }

  // As far along the line of sight as it may go; from a place beside that, the camera would look past its pivot.
  function dolly(factor) {
    const center = centerOf(pose), distance = clamped(sight() * factor, 0.15 * reach, 1e3 * reach);
    const wanted = minus(pivot, scaled(unit(minus(pivot, center)), distance));
    let share = isAllowed(wanted) ? 1 : 0;
    for (let step = 0.5; share < 1 && step > 1e-6; step /= 2) {
      if (isAllowed(mixed(center, wanted, share + step))) share += step;
    }
    set(poseAt(pose.rotation, mixed(center, wanted, share)), pivot);
  }

  function walk(ahead, right, rise) {
    shift(plus(plus(scaled(forward(), ahead), row(pose.rotation, 0), right), up, rise));
  }

  function flyTo(view) {
    still();
    stop = view;
    flight = { view, from: pose, to: poseOf(view), pivots: [pivot, pivotOf(view)], passed: 0 };
  }

  // The photographs that show a pane, each beside one that was taken near it; all where none shows any.
  function route() {
    const shown = views.filter((view) => scene.panes.some((pane) => {
      const { fx, fy, cx, cy, width, height } = view;
      const bounds = boundsOf(pane, poseOf(view), [fx, fy, cx, cy], [width, height], scene.near);
      return bounds && (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) > LEAST_SHOWN * width * height;
    }));
    const left = new Set(shown.length ? shown : views), ordered = [];
    for (let at = views[scene.first]; left.size; ordered.push(at)) {
      at = nearestTo(at.position, [...left]);
      left.delete(at);
    }
    return ordered;
  }

  const nearestTo = (position, among) => among.reduce((best, view) =>
    norm(minus(view.position, position)) < norm(minus(best.position, position)) ? view : best);

  // The photograph so many steps along the route from where the camera is, or flies to. Of those that were taken from
  // there, it is the one that was flown to last.
  function neighbour(step) {
    const here = flight ? flight.view.position : centerOf(pose), nearest = nearestTo(here, ordered);
    const isThere = norm(minus(stop.position, nearest.position)) < 1e-3 * reach;
    const index = Math.max(ordered.indexOf(isThere ? stop : nearest), 0);
    return ordered[(index + step + ordered.length) % ordered.length];
  }

  // A slow sway about the first view, so that reflections glide over the glass before anybody touches anything.
  function sway() { drift = { from: pose, target: pivot, passed: 0 }; }

  function still() {
    flight = drift = null;
    velocity.yaw = velocity.pitch = 0;
  }

  function swayed({ from, target, passed }) {
    const width = Math.min(0.45 * reach, 0.12 * norm(minus(target, centerOf(from))));
    const fade = Math.min(1, passed / 3), right = row(from.rotation, 0), down = row(from.rotation, 1);
    const place = plus(
      plus(centerOf(from), right, width * fade * Math.sin(passed * 0.45)), down, 0.3 * width * fade * Math.sin(passed * 0.31));
    set(poseAt(lookingAt(place, target, levelUp(from.rotation)), place), target);
  }

  function flown() {
    const t = EASE(Math.min(1, flight.passed / FLIGHT_SECONDS));
    const place = mixed(centerOf(flight.from), centerOf(flight.to), t);
    set(poseAt(between(flight.from.rotation, flight.to.rotation, t), place), mixed(...flight.pivots, t));
    if (t >= 1) flight = null;
  }

  // Moves on by a frame; whether anything is still moving.
  function advance(seconds) {
    if (flight) { flight.passed += seconds; flown(); return true; }
    if (drift) {
      drift.passed += seconds;
      if (drift.passed > 45) drift = null; else swayed(drift);
      return true;
    }
    if (Math.abs(velocity.yaw) + Math.abs(velocity.pitch) < 1e-3) return false;
    orbit(velocity.yaw * seconds, velocity.pitch * seconds);
    const brake = Math.exp(-6 * seconds);
    velocity.yaw *= brake;
    velocity.pitch *= brake;
    return true;
  }

  const ordered = route();
  stop = viewOfAddress(views) || views[scene.first];
  set(poseOf(stop), pivotOf(stop));
  return {
    advance, orbit, pan, dolly, walk, flyTo, neighbour, sway, still, velocity, sight,
    place: (next) => { still(); set(next, pivot); },
    pose: () => pose,
  };
}

// Mouse, pen and fingers: one turns, the right button or two fingers move, wheel and pinch go nearer.
function listenToPointers(canvas, navigation, touched) {
  const held = new Map();
  const middle = () => {
    const points = [...held.values()];
    const center = [0, 1].map((c) => points.reduce((sum, p) => sum + p[c], 0) / points.length);
    return { center, spread: points.length > 1 ? Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]) : 0 };
  };
  let last = null, time = 0;

  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY, event.button]);
    navigation.still();
    last = middle();
    touched();
  });
  canvas.addEventListener('pointermove', (event) => {
    if (!held.has(event.pointerId)) return;
    const button = held.get(event.pointerId)[2];
    held.set(event.pointerId, [event.clientX, event.clientY, button]);
    const now = middle(), dx = now.center[0] - last.center[0], dy = now.center[1] - last.center[1];
    const seconds = Math.max((event.timeStamp - time) / 1000, 1e-3), perPixel = 3.2 / Math.min(canvas.clientWidth, canvas.clientHeight);
    if (held.size > 1 || button === 2 || event.shiftKey) {
      const step = navigation.sight() / canvas.clientHeight;
      navigation.pan(-dx * step, -dy * step);
      if (last.spread && now.spread) navigation.dolly(last.spread / now.spread);
    } else {
      navigation.orbit(-dx * perPixel, dy * perPixel);
      navigation.velocity.yaw = 0.6 * navigation.velocity.yaw + (0.4 * -dx * perPixel) / seconds;
      navigation.velocity.pitch = 0.6 * navigation.velocity.pitch + (0.4 * dy * perPixel) / seconds;
    }
    last = now;
    time = event.timeStamp;
  });
  const released = (event) => {
    if (!held.delete(event.pointerId)) return;
    if (event.timeStamp - time > 80 || held.size || IS_STILL) navigation.velocity.yaw = navigation.velocity.pitch = 0;
    last = held.size ? middle() : null;
  };
  canvas.addEventListener('pointerup', released);
  canvas.addEventListener('pointercancel', released);
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    navigation.still();
    navigation.dolly(Math.exp(0.0012 * event.deltaY * (event.deltaMode ? 20 : 1)));
    touched();
  }, { passive: false });
}
