// --- pictures by WebGL 2: colours of vertices once per light, then triangles and the background

const ROW = 1024; // vertices in a row of a texture
const OF_VERTICES = ["clusters", "rank", "dense"]; // colourings, where the archive has them
const KINDS = { radiance: 0, light: 1, clusters: 2, rank: 2, dense: 2, error: 3 }; // as the shader tells them apart

// irradiance / pi of vertices: clustered PCA's second step, a pixel for each vertex
const COLOURS = `
precision highp usampler2D; precision highp sampler2DArray;
uniform usampler2D labels;
uniform sampler2DArray weights;
uniform sampler2D coefficients;
out vec4 colour;
void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  int label = int(texelFetch(labels, place, 0).r);
  vec3 total = texelFetch(coefficients, ivec2(0, label), 0).rgb;
  for (int k = 0; k < QUADS; k++) {
    vec3 a = texelFetch(coefficients, ivec2(1 + 4 * k, label), 0).rgb, b = texelFetch(coefficients, ivec2(2 + 4 * k, label), 0).rgb;
    vec3 c = texelFetch(coefficients, ivec2(3 + 4 * k, label), 0).rgb, d = texelFetch(coefficients, ivec2(4 + 4 * k, label), 0).rgb;
    vec4 w = texelFetch(weights, ivec3(place, k), 0);
    w *= abs(w);
    vec3 own = w.x * a + w.y * b + w.z * c + w.w * d;
#if CHANNELS == 3
    total.r += own.r;
    vec4 green = texelFetch(weights, ivec3(place, QUADS + k), 0), blue = texelFetch(weights, ivec3(place, 2 * QUADS + k), 0);
    total.g += dot(green * abs(green), vec4(a.g, b.g, c.g, d.g));
    total.b += dot(blue * abs(blue), vec4(a.b, b.b, c.b, d.b));
#else
    total += own;
#endif
  }
  colour = vec4(max(total, 0.0), 1.0);
}`;

// What a pixel sees: triangle + 1 (0 is the background), place in it, albedo, mesh + 1 (0 is black). Once for each view
const SEEN = `
precision highp usampler2D;
uniform usampler2D vertices; // position, 16 bits each, normal, 8 bits each, albedo, 16 bits each
uniform mat4 projected;
uniform vec3 low, extent, eye;
layout(location = 0) in uint vertex;
flat out int triangle;
out vec2 within;
out float seen;
#ifdef TEXTURED
uniform sampler2D texcoords;
out vec2 uv;
#else
out vec3 albedo;
#endif
void main() {
  triangle = gl_VertexID / 3;
  int corner = gl_VertexID - 3 * triangle;
  within = vec2(corner == 1, corner == 2);
  ivec2 place = ivec2(vertex % ${ROW}u, vertex / ${ROW}u);
  uvec4 words = texelFetch(vertices, place, 0);
  vec3 where = low + extent * (vec3(words.x & 65535u, words.x >> 16, words.y & 65535u) / 65535.0);
  vec3 normal = vec3(words.y >> 24, (words.y >> 16) & 255u, words.w >> 16) - 127.0;
  seen = dot(normal, eye - where);
#ifdef TEXTURED
  uv = texelFetch(texcoords, place, 0).xy;
#else
  albedo = vec3(words.z & 65535u, words.z >> 16, words.w & 65535u) / 65535.0;
#endif
  gl_Position = projected * vec4(where, 1.0);
}`;

const PIXEL = `
uniform int back;
uniform uint mesh;
flat in int triangle;
in vec2 within;
in float seen;
out uvec4 pixel;
#ifdef TEXTURED
uniform sampler2D image;
in vec2 uv;
#else
in vec3 albedo;
#endif
void main() {
  if (back == 1 && seen <= 0.0) discard;
#ifdef TEXTURED
  vec3 albedo = texture(image, uv).rgb;
#endif
  uint drawn = seen > 0.0 ? min(mesh + 1u, 65535u) : 0u; // one-sided surfaces are black from behind
  pixel = uvec4(triangle + 1, packUnorm2x16(within), packUnorm2x16(albedo.rg), packUnorm2x16(vec2(albedo.b, 0.0)) | drawn << 16);
}`;

// Radiance of pixels: as often as the light changes
const SHADING = `
precision highp usampler2D;
uniform usampler2D seen, triangles;
uniform sampler2D light, shine, environment, sharp;
uniform int kind, sharper;
uniform mat3 towards; // from places of the picture to the frame of the world
uniform mat3 turn; // from there to that of the environment
uniform float brightness;
in vec2 place;
out vec4 colour;
vec2 fromPole(vec2 uv, sampler2D image) { // Mitsuba's first and last rows of pixels lie at the poles
  float rows = float(textureSize(image, 0).y);
  return vec2(uv.x, (uv.y * (rows - 1.0) + 0.5) / rows);
}
vec3 background() {
  vec3 d = turn * normalize(towards * vec3(place, 1.0));
  vec2 uv = vec2(atan(d.x, -d.z) / 6.283185307, acos(clamp(d.y, -1.0, 1.0)) / 3.141592654);
  vec3 radiance = sharper == 1 ? textureLod(sharp, fromPole(uv, sharp), 0.0).rgb : vec3(1.0);
  if (max(radiance.r, max(radiance.g, radiance.b)) > 0.98) { // too bright for an image of 8 bits, or there is none
    vec3 blurred = textureLod(environment, fromPole(uv, environment), 0.0).rgb;
    radiance = sharper == 1 ? max(radiance, blurred) : blurred;
  }
  return radiance * brightness;
}
vec3 interpolated(sampler2D of, uvec3 vertices, vec3 weights) {
  vec3 sum = vec3(0.0);
  for (int k = 0; k < 3; k++)
    sum += weights[k] * texelFetch(of, ivec2(vertices[k] % ${ROW}u, vertices[k] / ${ROW}u), 0).rgb;
  return sum;
}
vec3 surface(uvec4 pixel) {
  uint mesh = pixel.w >> 16;
  if (mesh == 0u) return vec3(0.0);
  if (kind == 3) return texelFetch(light, ivec2((mesh - 1u) % ${ROW}u, (mesh - 1u) / ${ROW}u), 0).rgb;
  int triangle = int(pixel.x) - 1;
  uvec3 vertices = texelFetch(triangles, ivec2(triangle % ${ROW}, triangle / ${ROW}), 0).xyz;
  vec2 within = unpackUnorm2x16(pixel.y);
  vec3 weights = vec3(1.0 - within.x - within.y, within), radiance = interpolated(light, vertices, weights);
  if (kind == 0) {
    radiance *= vec3(unpackUnorm2x16(pixel.z), unpackUnorm2x16(pixel.w).x);
#ifdef SHINES
    radiance += interpolated(shine, vertices, weights);
#endif
  }
  return radiance;
}
void main() {
  uvec4 pixel = texelFetch(seen, ivec2(gl_FragCoord.xy), 0);
  colour = shown(pixel.x == 0u ? background() : surface(pixel));
}`;

const SAMPLES = [[1, -1], [-1, -1], [1, 1], [-1, 1]].map((offset) => offset.map((x) => x / 4)); // in a pixel, from its centre

class Picture extends Drawing {
  constructor(canvas, scene) {
    super(canvas);
    this.scene = scene;
    this.prepare();
  }

  // All that lives on the graphics card; again after it was lost
  prepare() {
    const { gl, scene } = this;
    if (!gl.getExtension("EXT_color_buffer_float"))
      throw new Error("This page needs float textures (EXT_color_buffer_float), which this graphics card does not have.");
    const textured = HEAD + "#define TEXTURED\n", shading = HEAD + (scene.shines ? "#define SHINES\n" : "") + TONE;
    this.programs = {
      plain: this.program(HEAD + SEEN, HEAD + PIXEL),
      textured: this.program(textured + SEEN, textured + PIXEL),
      shading: this.program(FILL, shading + SHADING),
    };
    this.size = [ROW, Math.ceil(scene.vertices / ROW)];
    if (scene.streamed) this.prepareStreamed();
    else this.prepareClusters();
    this.environments = new Map();
    this.albedos = scene.images.map((image) => this.image(image, gl.REPEAT));
    this.view = this.mean = null;
    this.geometry();
  }

  // Colours of vertices, and what glossy terms add or lamps shine, as Python sends them
  prepareStreamed() {
    const { gl, scene } = this, none = () => this.texture(gl.RGB16F, ...this.size, gl.RGB, gl.HALF_FLOAT, null);
    this.light = none();
    this.shine = scene.shines ? none() : null;
  }

  prepareClusters() {
    const { gl, scene } = this, { arrays } = scene, rows = this.size[1], quads = Math.ceil(scene.vectors / 4);
    const head = `${HEAD}#define QUADS ${quads}\n#define CHANNELS ${scene.channels}\n`;
    this.programs.colours = this.program(FILL, head + COLOURS);
    this.labels = this.texture(gl.R16UI, ROW, rows, gl.RED_INTEGER, gl.UNSIGNED_SHORT, padded(arrays.labels, ROW * rows));
    this.weights = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.weights);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8_SNORM, ROW, rows, quads * scene.channels);
    for (let layer = 0; layer < quads * scene.channels; layer++) {
      const own = new Int8Array(4 * ROW * rows), channel = Math.floor(layer / quads), first = (layer % quads) * 4;
      for (let c = 0; c < 4 && first + c < scene.vectors; c++) {
        const start = (channel * scene.vectors + first + c) * scene.vertices;
        for (let k = 0; k < scene.vertices; k++) own[4 * k + c] = arrays.weights[start + k];
      }
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, ROW, rows, 1, gl.RGBA, gl.BYTE, own);
    }
    this.coefficients = this.texture(gl.RGBA32F, scene.vectors + 1, scene.clusters, gl.RGBA, gl.FLOAT, null);
    this.light = this.texture(gl.RGBA32F, ROW, rows, gl.RGBA, gl.FLOAT, null);
    this.colours = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.colours);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.light, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // Colours (vertices, 3) in half floats, one array after the other
  receive(halves) {
    const { gl, scene } = this, count = 3 * scene.vertices;
    [this.light, this.shine].forEach((texture, k) => {
      if (!texture) return;
      gl.bindTexture(gl.TEXTURE_2D, texture);
      const own = padded(halves.subarray(k * count, (k + 1) * count), 3 * ROW * this.size[1]);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...this.size, gl.RGB, gl.HALF_FLOAT, own);
    });
  }

  // What is drawn are corners of triangles, each with the number of its vertex, which it looks up in a texture
  geometry() {
    const { gl, scene } = this, { arrays } = scene, rows = this.size[1], corners = new Uint32Array(arrays.triangles);
    this.corners = gl.createVertexArray();
    gl.bindVertexArray(this.corners);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    this.nothing = gl.createVertexArray();
    gl.bindVertexArray(this.nothing);
    const three = (kind, format, type, values) => {
      const lines = Math.ceil(values.length / (3 * ROW));
      return this.texture(kind, ROW, lines, format, type, padded(values, 3 * ROW * lines));
    };
    this.triangles = three(gl.RGB32UI, gl.RGB_INTEGER, gl.UNSIGNED_INT, corners);
    this.vertices = this.texture(gl.RGBA32UI, ROW, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, vertexWords(arrays, ROW * rows));
    this.colourings = {};
    for (const name of OF_VERTICES)
      if (arrays[name + "Colours"]) this.colourings[name] = three(gl.SRGB8, gl.RGB, gl.UNSIGNED_BYTE, arrays[name + "Colours"]);
    if (arrays.texcoords) this.texcoords = this.texture(gl.RG32F, ROW, rows, gl.RG, gl.FLOAT, padded(arrays.texcoords, 2 * ROW * rows));
    const errors = scene.meshes.flatMap(({ name }) => (scene.errors && scene.errors[name] ? scene.errors[name].colour : [0.2, 0.2, 0.2]));
    this.colourings.error = three(gl.RGB32F, gl.RGB, gl.FLOAT, Float32Array.from(errors));
  }

  // Textures of an environment, made when it is seen first: radiance, and a sharper image if it has one
  environment(light) {
    const { gl } = this;
    if (!this.environments.has(light)) {
      const radiance = this.texture(gl.RGB9_E5, light.width, light.height, gl.RGB, gl.UNSIGNED_INT_5_9_9_9_REV, light.words);
      this.filter(radiance, gl.CLAMP_TO_EDGE);
      this.environments.set(light, { radiance, image: light.image ? this.image(light.image, gl.CLAMP_TO_EDGE, gl.LINEAR) : null });
    }
    return this.environments.get(light);
  }

  filter(texture, wrap, smaller = this.gl.LINEAR) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, smaller);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, wrap);
  }

  // A texture of an image in sRGB that was decoded
  image(image, wrap, smaller = this.gl.LINEAR_MIPMAP_LINEAR) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
    if (smaller !== gl.LINEAR) gl.generateMipmap(gl.TEXTURE_2D);
    this.filter(texture, wrap, smaller);
    return texture;
  }

  // Colours of vertices from coefficients of clusters (clusters, vectors + 1, 4)
  relight(total) {
    const { gl, scene } = this, { program, uniforms } = this.programs.colours;
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, this.coefficients);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, scene.vectors + 1, scene.clusters, gl.RGBA, gl.FLOAT, total);
    this.bind(0, gl.TEXTURE_2D, this.labels, uniforms.labels);
    this.bind(1, gl.TEXTURE_2D_ARRAY, this.weights, uniforms.weights);
    this.bind(2, gl.TEXTURE_2D, this.coefficients, uniforms.coefficients);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.colours);
    gl.viewport(0, 0, ...this.size);
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // What the camera sees, by one sample in each pixel, or the mean of four
  draw(shown, smooth) {
    if (!smooth) return this.drawSample(shown, 0);
    SAMPLES.forEach((_, k) => this.addSample(shown, k));
  }

  // The mean of this sample and those before it
  addSample(shown, k) {
    const { gl, canvas } = this, { width, height } = canvas;
    this.mean = this.target(this.mean, width, height, gl.RGBA16F, false);
    // the last one is that of a light that turns
    this.drawSample(shown, (k + 1) % SAMPLES.length, this.mean.framebuffer, 1 / (k + 1));
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.mean.framebuffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  drawSample({ camera, light, turn, exposure, brightness, colours }, sample, framebuffer = null, share = 1) {
    const { gl, canvas, scene } = this, { width, height } = canvas;
    const view = camera.matrices(width / height, SAMPLES[sample].map((x, axis) => (2 * x) / [width, height][axis]));
    this.see(view, width, height);
    const { program, uniforms } = this.programs.shading, { radiance, image } = this.environment(light);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(program);
    this.bind(0, gl.TEXTURE_2D, this.view.texture, uniforms.seen);
    this.bind(1, gl.TEXTURE_2D, this.triangles, uniforms.triangles);
    this.bind(2, gl.TEXTURE_2D, this.colourings[colours] || this.light, uniforms.light);
    this.bind(3, gl.TEXTURE_2D, radiance, uniforms.environment);
    this.bind(4, gl.TEXTURE_2D, image || radiance, uniforms.sharp);
    if (scene.shines) this.bind(5, gl.TEXTURE_2D, this.shine, uniforms.shine);
    gl.uniform1i(uniforms.sharper, image ? 1 : 0);
    gl.uniform1i(uniforms.kind, KINDS[colours]);
    gl.uniformMatrix3fv(uniforms.towards, false, view.towards);
    gl.uniformMatrix3fv(uniforms.turn, false, turn.flat()); // its rows as columns: back to the environment
    gl.uniform1f(uniforms.brightness, brightness);
    gl.uniform1f(uniforms.exposure, exposure);
    gl.bindVertexArray(this.nothing);
    if (share < 1) gl.enable(gl.BLEND);
    gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    gl.blendColor(0, 0, 0, share);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
  }

  // What each pixel sees, if the view is another one than the last
  see({ projected, eye }, width, height) {
    const { gl, scene } = this, view = this.target(this.view, width, height, gl.RGBA32UI, true);
    if (view === this.view && projected.every((value, k) => value === view.projected[k])) return;
    this.view = Object.assign(view, { projected });
    gl.bindFramebuffer(gl.FRAMEBUFFER, view.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.bindVertexArray(this.corners);
    for (const name of ["plain", "textured"]) {
      const { program, uniforms } = this.programs[name];
      gl.useProgram(program);
      this.bind(0, gl.TEXTURE_2D, this.vertices, uniforms.vertices);
      if (name === "textured" && this.texcoords) this.bind(1, gl.TEXTURE_2D, this.texcoords, uniforms.texcoords);
      gl.uniformMatrix4fv(uniforms.projected, false, projected);
      gl.uniform3fv(uniforms.low, scene.low);
      gl.uniform3fv(uniforms.extent, scene.extent);
      gl.uniform3fv(uniforms.eye, eye);
      scene.meshes.forEach((mesh, k) => {
        if ((mesh.texture !== null) === (name === "textured")) this.drawMesh(mesh, k, uniforms);
      });
    }
  }

  drawMesh(mesh, number, uniforms) {
    const { gl } = this;
    if (uniforms.image) this.bind(2, gl.TEXTURE_2D, this.albedos[mesh.texture], uniforms.image);
    gl.uniform1i(uniforms.back, mesh.back ? 1 : 0);
    gl.uniform1ui(uniforms.mesh, number);
    if (mesh.back) gl.enable(gl.POLYGON_OFFSET_FILL); // it lies where its front lies
    gl.polygonOffset(-1, -1);
    gl.drawArrays(gl.TRIANGLES, mesh.first, mesh.count);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  // A texture that is drawn into: the old one if it has this size
  target(old, width, height, kind, hasDepth) {
    const { gl } = this;
    if (old && old.width === width && old.height === height) return old;
    if (old) gl.deleteTexture(old.texture);
    if (old && old.depth) gl.deleteRenderbuffer(old.depth);
    const framebuffer = old ? old.framebuffer : gl.createFramebuffer(), texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, kind, width, height);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    const depth = hasDepth ? gl.createRenderbuffer() : null;
    if (depth) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    }
    return { framebuffer, texture, depth, width, height };
  }
}

function padded(values, length) {
  const result = new values.constructor(length);
  result.set(values);
  return result;
}

// Position, normal and albedo of each vertex in four words
function vertexWords({ positions, normals, albedo }, count) {
  const words = new Uint32Array(4 * count);
  for (let k = 0; 3 * k < positions.length; k++) {
    const [x, y, z] = positions.subarray(3 * k), [red, green, blue] = albedo.subarray(3 * k);
    const [a, b, c] = Array.from(normals.subarray(3 * k, 3 * k + 3), (n) => n + 127);
    words[4 * k] = x | (y << 16);
    words[4 * k + 1] = z | (b << 16) | (a << 24);
    words[4 * k + 2] = red | (green << 16);
    words[4 * k + 3] = blue | (c << 16);
  }
  return words;
}
