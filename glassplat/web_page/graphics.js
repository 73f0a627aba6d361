// What a picture is drawn with: programs, textures, framebuffers.

const HEAD = '#version 300 es\n';
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;

function makeGraphics(canvas) {
  const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, depth: false, powerPreference: 'high-performance' });
  if (!gl) throw new Error(`this browser has no WebGL 2; ${CURRENT}`);
  const named = gl.getExtension('WEBGL_debug_renderer_info');
  const isSoftware = named ? SOFTWARE.test(gl.getParameter(named.UNMASKED_RENDERER_WEBGL)) : false;
  const single = ['EXT_color_buffer_float', 'EXT_float_blend', 'OES_texture_float_linear'].map((name) => gl.getExtension(name)).every(Boolean);
  const half = gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float');
  // Processors blend single precision twice as fast as half, graphics cards the other way round.
  const formats = isSoftware && single ? { 1: gl.R32F, 4: gl.RGBA32F } : half ? { 1: gl.R16F, 4: gl.RGBA16F } : { 1: gl.R8, 4: gl.RGBA8 };
  gl.disable(gl.DEPTH_TEST);
  gl.disable(gl.DITHER);

  function compiled(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) || 'shader lost');
    return shader;
  }

  function program(vertex, fragment, constants = {}) {
    const defines = Object.entries(constants).map(([name, value]) => `#define ${name} ${value}\n`).join('');
    const made = gl.createProgram(), head = HEAD + defines + SHADERS['texels.glsl'];
    gl.attachShader(made, compiled(gl.VERTEX_SHADER, head + SHADERS[vertex]));
    gl.attachShader(made, compiled(gl.FRAGMENT_SHADER, head + SHADERS[fragment]));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || 'program lost');
    const places = new Map();
    const at = (name) => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(made, name));
      return places.get(name);
    };
    return { made, at };
  }

  function filtered(target, filter) {
    for (const name of ['MIN_FILTER', 'MAG_FILTER']) gl.texParameteri(target, gl[`TEXTURE_${name}`], filter);
    for (const name of ['WRAP_S', 'WRAP_T']) gl.texParameteri(target, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
  }

  function dataTexture(internal, format, data, channels, height = data.length / (channels * ROW)) {
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, ROW, height, 0, format, gl.UNSIGNED_INT, data);
    filtered(gl.TEXTURE_2D, gl.NEAREST);
    return texture;
  }

  function image(width, height, format, layers = null) {
    const target = layers === null ? gl.TEXTURE_2D : gl.TEXTURE_2D_ARRAY, texture = gl.createTexture();
    gl.bindTexture(target, texture);
    if (layers === null) gl.texStorage2D(target, 1, format, width, height);
    else gl.texStorage3D(target, 1, format, width, height, Math.max(layers, 1));
    filtered(target, gl.LINEAR);
    return texture;
  }

  // Six faces of sRGB bytes.
  function cube(bytes) {
    const side = Math.sqrt(bytes.length / 18), face = bytes.length / 6, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_CUBE_MAP, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    for (let k = 0; k < 6; k++) {
      const part = bytes.subarray(k * face, (k + 1) * face);
      gl.texImage2D(gl.TEXTURE_CUBE_MAP_POSITIVE_X + k, 0, gl.RGB8, side, side, 0, gl.RGB, gl.UNSIGNED_BYTE, part);
    }
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    filtered(gl.TEXTURE_CUBE_MAP, gl.LINEAR);
    return texture;
  }

  function framebuffer(attachments) {
    const made = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, made);
    attachments.forEach(([texture, layer = null], k) => {
      if (layer === null) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0);
      else gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, texture, 0, layer);
    });
    gl.drawBuffers(attachments.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    return made;
  }

  // Two triangles for each four vertices; some drivers draw instances one by one.
  function rectangles(count) {
    const indices = new Uint32Array(6 * count), array = gl.createVertexArray();
    for (let i = 0; i < count; i++) indices.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    return array;
  }

  // Returns what sets uniforms of one kind by their names; of matrices, true says that they come by rows.
  function use({ made, at }, textures) {
    gl.useProgram(made);
    textures.forEach(([name, target, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture);
      gl.uniform1i(at(name), unit);
    });
    return (kind, values, ...byRows) => {
      for (const [name, value] of Object.entries(values)) gl[`uniform${kind}`](at(name), ...byRows, value);
    };
  }

  // Whether everything that was asked for until now is drawn, whenever one asks.
  function fence() {
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return () => {
      const isDone = gl.isContextLost() || gl.getSyncParameter(sync, gl.SYNC_STATUS) === gl.SIGNALED;
      if (isDone) gl.deleteSync(sync);
      return isDone;
    };
  }

  return { gl, isSoftware, formats, program, dataTexture, image, cube, framebuffer, rectangles, use, fence };
}
