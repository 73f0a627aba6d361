// Draws a view: transmission, the panes' masks and what each mirrors, then the sum of all.

const LAWS = ['pane', 'schlick', 'none'];
const LAYERS = { rgb: 0, without_panes: 1, reflection: 2, strength: 3 };

function makeRenderer(canvas, scene) {
  const graphics = makeGraphics(canvas), { gl, formats, use, isSoftware } = graphics;
  const shiny = Boolean(scene.mirrored), panes = scene.panes, rows = texelRows(scene.total);
  const splatProgram = (constants) => graphics.program('splat.vert', 'splat.frag', constants);
  const programs = {
    project: graphics.program('screen.vert', 'project.frag'),
    direct: splatProgram(shiny ? { COLORED: 1, CHANNELED: 1, SHINY: 1 } : { COLORED: 1, CHANNELED: 0 }),
    mask: splatProgram({ COLORED: 0, CHANNELED: 1 }),
    mirrored: splatProgram({ COLORED: 1, CHANNELED: scene.intensity ? 1 : 0 }),
    copy: graphics.program('screen.vert', 'copy.frag'),
    compose: graphics.program('screen.vert', 'compose.frag', { PANES: panes.length, ...(shiny && { SHINY: 1 }) }),
  };
  const inputs = {
    places: graphics.dataTexture(gl.RGBA32UI, gl.RGBA_INTEGER, scene.places, 4),
    shapes: graphics.dataTexture(gl.RG32UI, gl.RG_INTEGER, scene.shapes, 2),
    harmonics: graphics.dataTexture(gl.RGBA32UI, gl.RGBA_INTEGER, scene.harmonics, 4),
  };
  const projected = [0, 1].map(() => graphics.dataTexture(gl.RGBA32UI, gl.RGBA_INTEGER, null, 4, rows));
  const projection = graphics.framebuffer(projected.map((texture) => [texture]));
  const newOrder = () => ({ texture: graphics.dataTexture(gl.R32UI, gl.RED_INTEGER, null, 1, rows), count: 0 });
  // As camerasToSort() has them.
  const orders = { direct: newOrder(), joint: newOrder(), masks: ownMasks(scene).map(newOrder), mirrored: panes.map(newOrder) };
  const ordered = [orders.direct, orders.joint, ...orders.masks, ...orders.mirrored];
  const cube = shiny && graphics.cube(scene.cube);
  const rectangles = graphics.rectangles(scene.total), empty = gl.createVertexArray();
  let targets = null;

  function resize(width, height) {
    if (targets && targets.width === width && targets.height === height) return false;
    if (targets) {
      for (const texture of targets.textures) gl.deleteTexture(texture);
      for (const one of [targets.direct, targets.coarse, ...targets.covered, ...targets.mirrored]) gl.deleteFramebuffer(one);
    }
    canvas.width = width;
    canvas.height = height;
    const textures = [[formats[4]], [formats[1], 1 + orders.masks.length], [formats[4], panes.length], [formats[1], panes.length], [gl.RGBA8], ...(shiny ? [[formats[1]], [formats[4]]] : [])]
      .map(([format, layers]) => graphics.image(width, height, format, layers));
    const [image, masks, reflections, gains, small, ...surface] = textures;
    targets = {
      width, height, textures, image, masks, reflections, gains, small, surface,
      direct: graphics.framebuffer([[image], ...surface.map((texture) => [texture])]),
      covered: [orders.joint, ...orders.masks].map((_, k) => graphics.framebuffer([[masks, k]])),
      mirrored: panes.map((_, k) => graphics.framebuffer([[reflections, k], ...(scene.intensity ? [[gains, k]] : [])])),
      coarse: graphics.framebuffer([[small]]),
    };
    return true;
  }

  // One triangle over all of a target.
  function cover(target, width, height) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, width, height);
    gl.bindVertexArray(empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // side: of the pane that the pose is mirrored in, if it is; degree: of the harmonics that matter.
  function project(order, { pose, size, bounds, intrinsics, faintest, degree = scene.degree, side = null }) {
    const textures = { ...inputs, order: order.texture };
    const set = use(programs.project, Object.entries(textures).map(([name, texture]) => [name, gl.TEXTURE_2D, texture]));
    const { firstGlass, perSplat, near, channelRange } = scene;
    set('1i', { count: order.count, firstGlass, degree, harmonicTexels: perSplat, mirrored: side !== null, shiny });
    set('1f', { near, faintest });
    set('2fv', { size, channelRange });
    set('3fv', { offset: pose.offset, eye: centerOf(pose) });
    set('4fv', { intrinsics, bounds, clipPlane: side || [0, 0, 0, 1] });
    set('Matrix3fv', { camFromWorld: pose.rotation }, true);
    cover(projection, ROW, texelRows(order.count));
  }

  // Projected splats from one place of their order to another, over what is there, or instead of it.
  function splat(which, [from, to], target, { size, bounds: [left, top, right, bottom] }) {
    const set = use(programs[which], [['projected', gl.TEXTURE_2D, projected[0]], ['looks', gl.TEXTURE_2D, projected[1]]]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, ...size);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, size[1] - bottom, right - left, bottom - top);
    if (!from) gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    set('2fv', { size });
    gl.bindVertexArray(rectangles);
    gl.drawElements(gl.TRIANGLES, 6 * (to - from), gl.UNSIGNED_INT, 24 * from);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
  }

  function compose(view, present, { size, used, intrinsics }, usedByMirrors, target) {
    const set = use(programs.compose, [
      ['image', gl.TEXTURE_2D, targets.image],
      ...(panes.length ? ['masks', 'reflections', 'gains'].map((name) => [name, gl.TEXTURE_2D_ARRAY, targets[name]]) : []),
      ...(shiny ? [['strengths', gl.TEXTURE_2D, targets.surface[0]], ['normals', gl.TEXTURE_2D, targets.surface[1]], ['surroundings', gl.TEXTURE_CUBE_MAP, cube]] : []),
    ]);
    const { rotation } = view.pose, { background, fresnel, blend, intensity, nearest } = scene;
    if (panes.length) {
      const ofEach = (value) => panes.flatMap(value), turnedEach = (key) => ofEach((pane) => turned(rotation, pane[key]));
      set('1iv', { present });
      set('1fv', { reflectances: view.reflectances });
      set('2fv', { halfSizes: ofEach((pane) => pane.half) });
      set('3fv', {
        centers: ofEach((pane) => inCamera(view.pose, pane.center)), transmittances: ofEach((pane) => pane.transmittance),
        normals: turnedEach('normal'), tangents: turnedEach('tangent'), bitangents: turnedEach('bitangent'),
      });
    }
    if (shiny) set('Matrix3fv', { camFromWorld: rotation }, true);
    set('1i', { law: LAWS.indexOf(fresnel), linearLight: blend === 'linear', gained: intensity, nearestOnly: nearest });
    set('1f', { divider: view.divider * size[0] });
    set('2iv', { layers: view.layers.map((name) => LAYERS[name]) });
    set('2fv', { size, used, usedByMirrors });
    set('3fv', { background });
    set('4fv', { intrinsics });
    cover(target, ...size);
  }

  // The part of the targets that is drawn at a scale, and its intrinsics.
  function sized(view, scale) {
    const size = [targets.width, targets.height].map((side) => Math.max(1, Math.round(side * scale)));
    const used = [size[0] / targets.width, size[1] / targets.height];
    return { size, used, bounds: [0, 0, ...size], intrinsics: view.intrinsics.map((value, k) => value * used[k % 2]) };
  }

  function* splats(which, order, target, place, most) {
    project(order, place);
    let from = 0;
    do {
      const to = Math.min(order.count, from + most(which));
      splat(which, [from, to], target, place);
      yield { which, splats: to - from };
      from = to;
    } while (from < order.count);
  }

  // Draws a view in steps of at most so many splats, and shows it.
  // view: pose, intrinsics of the whole canvas, scale of what is drawn, layers left and right of the divider (a share
  // of the width), reflectances; glass says of each pane whether it is there. A moving picture leaves out what is
  // faint, and what a pane reflects weakly is drawn at half its scale.
  function* drawing(view, most = () => Infinity) {
    const faintest = view.moving ? 1 / 40 : 1 / 255;
    const placed = (scale) => ({ ...sized(view, scale), pose: view.pose, faintest });
    const direct = placed(view.scale), mirrors = placed(scaleOfMirrors(view));
    yield* splats('direct', orders.direct, targets.direct, direct, most);
    const bounds = panes.map((pane, k) => view.glass[k] && boundsOf(pane, view.pose, mirrors.intrinsics, mirrors.size, scene.near));
    const mask = (order, k, area) => splats('mask', order, targets.covered[k], { ...mirrors, bounds: area, degree: 0 }, most);
    const overlap = overlapping(bounds), present = panes.map(() => 0);
    if (bounds.some(Boolean)) yield* mask(orders.joint, 0, around(bounds));
    for (const [k, pane] of panes.entries()) {
      if (!bounds[k]) continue;
      const side = sideOf(pane, view.pose), pose = mirroredPose(view.pose, pane), own = orders.masks[k];
      present[k] = own?.isKnown && overlap[k] ? 2 : 1;
      // Where only panes that were taken away overlap it, the mask of all must not be of their glass.
      if (own?.isKnown) yield* mask(own, overlap[k] ? k + 1 : 0, bounds[k]);
      yield* splats('mirrored', orders.mirrored[k], targets.mirrored[k], { ...mirrors, bounds: bounds[k], pose, side }, most);
    }
    show(view, present, direct, mirrors);
  }

  // In software what is drawn small is composed small, too.
  function show(view, present, direct, mirrors) {
    const { width, height } = targets;
    if (!isSoftware || view.scale === 1) {
      compose(view, present, { size: [width, height], used: direct.used, intrinsics: view.intrinsics }, mirrors.used, null);
      return;
    }
    compose(view, present, direct, mirrors.used, targets.coarse);
    // Not by blitFramebuffer(), after which Chromium's canvas stays black.
    use(programs.copy, [['image', gl.TEXTURE_2D, targets.small]])('2fv', { size: [width, height], used: direct.used });
    cover(null, width, height);
  }

  function setOrder(k, sorted) {
    ordered[k].isKnown = Boolean(sorted);
    if (!sorted) return;
    const whole = Math.floor(sorted.length / ROW), rest = sorted.length % ROW;
    gl.bindTexture(gl.TEXTURE_2D, ordered[k].texture);
    const write = (row, width, height, data) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, data);
    if (whole) write(0, ROW, whole, sorted.subarray(0, whole * ROW));
    if (rest) write(whole, rest, 1, sorted.subarray(whole * ROW));
    ordered[k].count = sorted.length;
  }

  function pixels() {
    const data = new Uint8Array(4 * targets.width * targets.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, targets.width, targets.height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    return data;
  }

  const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  return { drawing, resize, setOrder, pixels, isSoftware, largest, fence: graphics.fence, isLost: () => gl.isContextLost() };
}
