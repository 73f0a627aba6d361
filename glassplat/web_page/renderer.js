// Draws a view: transmission and masks, what each visible pane mirrors, then the sum of both.

const LAWS = ['pane', 'schlick', 'none'];
const LAYERS = { rgb: 0, without_panes: 1, reflection: 2, strength: 3, mask: 4 };
const HEAD = '#version 300 es\n';
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;

function makeRenderer(canvas, scene) {
  const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, depth: false, powerPreference: 'high-performance' });
  if (!gl) throw new Error('this browser has no WebGL 2; try a current Firefox, Chrome, Edge or Safari');
  const half = gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float');
  const named = gl.getExtension('WEBGL_debug_renderer_info');
  const panes = scene.panes, buffers = gl.getParameter(gl.MAX_DRAW_BUFFERS);
  const masks = panes.length < buffers ? panes.length : Math.min(1, panes.length);
  const programs = {
    project: program('screen.vert', 'texels.glsl', 'project.frag'),
    reflected: program('splat.vert', null, 'splat.frag', { masks: 1 }),
    direct: program('splat.vert', null, 'splat.frag', { masks }),
    compose: program('screen.vert', null, 'compose.frag', { panes: panes.length, masks }),
  };
  const inputs = {
    places: dataTexture(gl.RGBA32UI, gl.RGBA_INTEGER, scene.places, 4),
    shapes: dataTexture(gl.RG32UI, gl.RG_INTEGER, scene.shapes, 2),
    harmonics: dataTexture(gl.RGBA32UI, gl.RGBA_INTEGER, scene.harmonics, 4),
  };
  const rows = texelRows(scene.total);
  const projected = [0, 1].map(() => dataTexture(gl.RGBA32UI, gl.RGBA_INTEGER, null, 4, rows));
  const projection = framebuffer(projected.map((texture) => [texture, null]));
  const orders = [null, ...panes].map(() => ({ texture: dataTexture(gl.R32UI, gl.RED_INTEGER, null, 1, rows), count: 0 }));
  const rectangles = indexed(scene.total), empty = gl.createVertexArray();
  let targets = null;
  gl.disable(gl.DEPTH_TEST);
  gl.disable(gl.DITHER);

  function compiled(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) || 'shader lost');
    return shader;
  }

  function program(vertex, shared, fragment, { panes: count = 0, masks: outputs = 0 } = {}) {
    const each = (text) => Array.from({ length: outputs }, (_, k) => text(k)).join(' ');
    const defines = `${HEAD}#define PANES ${count}\n#define MASKS ${outputs}\n`
      + `#define MASK_OUTPUTS ${each((k) => `layout(location = ${k + 1}) out vec4 mask${k};`)}\n`
      + `#define WRITE_MASKS ${each((k) => `mask${k} = maskOf(${k});`)}\n`;
    const made = gl.createProgram(), texels = SHADERS['texels.glsl'];
    gl.attachShader(made, compiled(gl.VERTEX_SHADER, defines + texels + SHADERS[vertex]));
    gl.attachShader(made, compiled(gl.FRAGMENT_SHADER, defines + (shared ? SHADERS[shared] : '') + SHADERS[fragment]));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || 'program lost');
    const places = new Map();
    const at = (name) => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(made, name));
      return places.get(name);
    };
    return { made, at };
  }

  function dataTexture(internal, format, data, channels, height = data.length / (channels * ROW)) {
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, ROW, height, 0, format, gl.UNSIGNED_INT, data);
    filtered(gl.TEXTURE_2D, gl.NEAREST);
    return texture;
  }

  function filtered(target, filter) {
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  function framebuffer(attachments) {
    const made = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, made);
    attachments.forEach(([texture, layer], k) => {
      if (layer === null) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0);
      else gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, texture, 0, layer);
    });
    gl.drawBuffers(attachments.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    return made;
  }

  // Two triangles for each four vertices. Not instances, which some drivers, and all in software, draw one by one.
  function indexed(count) {
    const indices = new Uint32Array(6 * count), array = gl.createVertexArray();
    for (let i = 0; i < count; i++) indices.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    return array;
  }

  function image(width, height, channels, layers) {
    const target = layers === null ? gl.TEXTURE_2D : gl.TEXTURE_2D_ARRAY, texture = gl.createTexture();
    const format = half ? { 1: gl.R16F, 4: gl.RGBA16F } : { 1: gl.R8, 4: gl.RGBA8 };
    gl.bindTexture(target, texture);
    if (layers === null) gl.texStorage2D(target, 1, format[channels], width, height);
    else gl.texStorage3D(target, 1, format[channels], width, height, Math.max(layers, 1));
    filtered(target, gl.LINEAR);
    return texture;
  }

  function resize(width, height) {
    if (targets && targets.width === width && targets.height === height) return;
    if (targets) {
      for (const name of ['image', 'masks', 'reflections', 'gains']) gl.deleteTexture(targets[name]);
      for (const one of [targets.direct, ...targets.mirrored]) gl.deleteFramebuffer(one);
    }
    canvas.width = width;
    canvas.height = height;
    const seen = image(width, height, 4, null), covers = image(width, height, 1, masks);
    const reflections = image(width, height, 4, panes.length), gains = image(width, height, 1, panes.length);
    const layers = Array.from({ length: masks }, (_, k) => [covers, k]);
    targets = {
      width, height, image: seen, masks: covers, reflections, gains,
      direct: framebuffer([[seen, null], ...layers]),
      mirrored: panes.map((_, k) => framebuffer([[reflections, k], [gains, k]])),
    };
  }

  function use({ made, at }, textures) {
    gl.useProgram(made);
    textures.forEach(([name, target, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture);
      gl.uniform1i(at(name), unit);
    });
    return at;
  }

  function project(pose, intrinsics, size, bounds, faintest, pane) {
    const at = use(programs.project, Object.entries(inputs).map(([name, texture]) => [name, gl.TEXTURE_2D, texture]));
    gl.bindFramebuffer(gl.FRAMEBUFFER, projection);
    gl.viewport(0, 0, ROW, rows);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
    gl.uniform1i(at('count'), scene.total);
    gl.uniform1i(at('firstGlass'), scene.firstGlass);
    gl.uniform1i(at('degree'), scene.degree);
    gl.uniform1i(at('harmonicTexels'), scene.perSplat);
    gl.uniform1i(at('masks'), Math.max(masks, 1));
    gl.uniformMatrix3fv(at('camFromWorld'), true, pose.rotation);
    gl.uniform3fv(at('offset'), pose.offset);
    gl.uniform3fv(at('eye'), centerOf(pose));
    gl.uniform4fv(at('intrinsics'), intrinsics);
    gl.uniform2fv(at('size'), size);
    gl.uniform4fv(at('bounds'), bounds);
    gl.uniform4fv(at('clipPlane'), pane ? pane.side : [0, 0, 0, 1]);
    gl.uniform1f(at('near'), scene.near);
    gl.uniform2fv(at('channelRange'), scene.channelRange);
    gl.uniform1f(at('faintest'), faintest);
    gl.uniform1i(at('mirrored'), pane ? 1 : 0);
    gl.bindVertexArray(empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  function splat(which, order, target, size, bounds) {
    const textures = { projected: projected[0], looks: projected[1], order: order.texture };
    const at = use(programs[which], Object.entries(textures).map(([name, texture]) => [name, gl.TEXTURE_2D, texture]));
    const [left, top, right, bottom] = bounds;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, size[0], size[1]);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, size[1] - bottom, right - left, bottom - top);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniform2fv(at('size'), size);
    gl.bindVertexArray(rectangles);
    gl.drawElements(gl.TRIANGLES, 6 * order.count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
  }

  function compose(view, seen, used, usedByMirrors) {
    const at = use(programs.compose, [
      ['image', gl.TEXTURE_2D, targets.image],
      ...(panes.length ? ['masks', 'reflections', 'gains'].map((name) => [name, gl.TEXTURE_2D_ARRAY, targets[name]]) : []),
    ]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, targets.width, targets.height);
    if (panes.length) {
      const { rotation } = view.pose;
      gl.uniform3fv(at('centers'), panes.flatMap((pane) => inCamera(view.pose, pane.center)));
      for (const [name, key] of [['normals', 'normal'], ['tangents', 'tangent'], ['bitangents', 'bitangent']]) {
        gl.uniform3fv(at(name), panes.flatMap((pane) => turned(rotation, pane[key])));
      }
      gl.uniform2fv(at('halfSizes'), panes.flatMap((pane) => pane.half));
      gl.uniform1fv(at('reflectances'), view.reflectances);
      gl.uniform1iv(at('present'), panes.map((_, k) => (seen.includes(k) ? 1 : 0)));
    }
    gl.uniform4fv(at('intrinsics'), view.intrinsics);
    gl.uniform2f(at('size'), targets.width, targets.height);
    gl.uniform2fv(at('used'), used);
    gl.uniform2fv(at('usedByMirrors'), usedByMirrors);
    gl.uniform3fv(at('background'), scene.background);
    gl.uniform2i(at('layers'), LAYERS[view.layers[0]], LAYERS[view.layers[1]]);
    gl.uniform1f(at('divider'), view.divider * targets.width);
    gl.uniform1i(at('law'), LAWS.indexOf(scene.fresnel));
    gl.uniform1i(at('linearLight'), scene.blend === 'linear' ? 1 : 0);
    gl.uniform1i(at('gained'), scene.intensity ? 1 : 0);
    gl.bindVertexArray(empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The part of the targets that is drawn at a scale, and the intrinsics of a picture of that size.
  function sized(view, scale) {
    const size = [targets.width, targets.height].map((side) => Math.max(1, Math.round(side * scale)));
    const used = [size[0] / targets.width, size[1] / targets.height];
    return { size, used, intrinsics: view.intrinsics.map((value, k) => value * used[k % 2]) };
  }

  // view: pose, intrinsics of the whole canvas, scale of what is drawn, layers left and right of the divider (a share
  // of the width), reflectances; glass says whether the panes are drawn at all. A moving picture leaves out what is
  // faint, and what a pane reflects weakly is drawn at half its scale.
  function draw(view) {
    const faintest = view.scale < 1 ? 1 / 40 : 1 / 255, weak = view.scale < 1 && Math.max(...view.reflectances, 0) < 0.3;
    const direct = sized(view, view.scale), mirrors = sized(view, weak ? 0.5 * view.scale : view.scale);
    const whole = [0, 0, ...direct.size], seen = [];
    project(view.pose, direct.intrinsics, direct.size, whole, faintest, null);
    splat('direct', orders[0], targets.direct, direct.size, whole);
    panes.forEach((pane, k) => {
      const bounds = view.glass && boundsOf(pane, view.pose, mirrors.intrinsics, mirrors.size, scene.near);
      if (!bounds) return;
      const side = sideOf(pane, view.pose);
      project(mirroredPose(view.pose, pane), mirrors.intrinsics, mirrors.size, bounds, faintest, { side });
      splat('reflected', orders[k + 1], targets.mirrored[k], mirrors.size, bounds);
      seen.push(k);
    });
    compose(view, seen, direct.used, mirrors.used);
  }

  function setOrder(k, sorted) {
    const whole = Math.floor(sorted.length / ROW), rest = sorted.length % ROW;
    gl.bindTexture(gl.TEXTURE_2D, orders[k].texture);
    const write = (row, width, height, data) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, data);
    if (whole) write(0, ROW, whole, sorted.subarray(0, whole * ROW));
    if (rest) write(whole, rest, 1, sorted.subarray(whole * ROW));
    orders[k].count = sorted.length;
  }

  function pixels() {
    const data = new Uint8Array(4 * targets.width * targets.height);
    gl.readPixels(0, 0, targets.width, targets.height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    return data;
  }

  const isSoftware = named ? SOFTWARE.test(gl.getParameter(named.UNMASKED_RENDERER_WEBGL)) : false;
  return { draw, resize, setOrder, pixels, isSoftware, finish: () => gl.finish(), isLost: () => gl.isContextLost() };
}

// The half space on the camera's side of a pane, as a plane that is positive there.
function sideOf(pane, pose) {
  const facing = Math.sign(dot(minus(centerOf(pose), pane.center), pane.normal)), normal = scaled(pane.normal, facing);
  return [...normal, -dot(normal, pane.center)];
}

// Left, top, right and bottom of a pane in pixels, null where the camera does not see it.
function boundsOf(pane, pose, [fx, fy, cx, cy], [width, height], near) {
  const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([s, t]) =>
    inCamera(pose, plus(plus(pane.center, pane.tangent, s * pane.half[0]), pane.bitangent, t * pane.half[1])));
  const front = [], least = 0.01 * near;
  corners.forEach((corner, k) => {
    const next = corners[(k + 1) % 4];
    if (corner[2] > least) front.push(corner);
    if (corner[2] > least !== next[2] > least) front.push(mixed(corner, next, (least - corner[2]) / (next[2] - corner[2])));
  });
  if (!front.length) return null;
  const x = front.map((p) => (fx * p[0]) / p[2] + cx), y = front.map((p) => (fy * p[1]) / p[2] + cy);
  const bounds = [
    Math.max(0, Math.floor(Math.min(...x)) - 1), Math.max(0, Math.floor(Math.min(...y)) - 1),
    Math.min(width, Math.ceil(Math.max(...x)) + 1), Math.min(height, Math.ceil(Math.max(...y)) + 1),
  ];
  return bounds[0] < bounds[2] && bounds[1] < bounds[3] ? bounds : null;
}

// What the sorter has to know of a view: the camera itself, and one camera per pane, which shows what the pane covers.
// A view has moved on before its order is there, so that windows, in tangents, are wider than the picture.
const SPARE = 0.3;

function camerasToSort(pose, { intrinsics, size }, scene) {
  const window = (bounds) => bounds.map((edge, k) => {
    const spare = (k < 2 ? -SPARE : SPARE) * size[k % 2];
    return (edge + spare - intrinsics[2 + (k % 2)]) / intrinsics[k % 2];
  });
  const camera = ({ rotation, offset }, clip, last, bounds) =>
    ({ rows: rotation, offset, near: scene.near, clip, last, window: window(bounds || [0, 0, ...size]) });
  return [
    camera(pose, null, scene.total, null),
    ...scene.panes.map((pane) => camera(mirroredPose(pose, pane), sideOf(pane, pose), scene.firstGlass,
      boundsOf(pane, pose, intrinsics, size, scene.near))),
  ];
}
