// --- pictures by WebGL 2: colours of vertices once per light, then triangles and the background

const ROW = 1024; // vertices in a row of a texture

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

const BACKGROUND = HEAD + TONE + `
uniform sampler2D environment, sharp;
uniform int sharper;
uniform mat3 towards; // from places of the picture to the frame of the world
uniform float degrees;
in vec2 place;
out vec4 colour;
void main() {
  vec3 d = normalize(towards * vec3(place, 1.0));
  vec2 uv = vec2(atan(d.x, -d.z) / 6.283185307 + degrees / 360.0, acos(clamp(d.y, -1.0, 1.0)) / 3.141592654);
  vec3 radiance = sharper == 1 ? textureLod(sharp, uv, 0.0).rgb : vec3(1.0);
  if (max(radiance.r, max(radiance.g, radiance.b)) > 0.98) { // too bright for an image of 8 bits, or there is none
    vec3 blurred = textureLod(environment, uv, 0.0).rgb;
    radiance = sharper == 1 ? max(radiance, blurred) : blurred;
  }
  colour = shown(radiance);
}`;

// few numbers from vertex to pixel: software renderers take as long for these as for the pixels
const SURFACE = `
uniform sampler2D light;
#ifdef SHINES
uniform sampler2D shine;
out vec3 gloss;
#endif
uniform mat4 projected;
uniform vec3 low, extent, eye;
uniform int kind;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 albedo;
layout(location = 3) in vec3 cluster;
out float seen;
out vec3 radiance;
#ifdef TEXTURED
layout(location = 4) in vec2 uv;
out vec2 texcoords;
#endif
void main() {
  vec3 where = low + extent * position;
  seen = dot(normal, eye - where);
  ivec2 own = ivec2(gl_VertexID % ${ROW}, gl_VertexID / ${ROW});
  radiance = kind == 2 ? cluster : texelFetch(light, own, 0).rgb;
#ifdef SHINES
  gloss = kind == 0 ? texelFetch(shine, own, 0).rgb : vec3(0.0);
#endif
#ifdef TEXTURED
  texcoords = uv;
#else
  if (kind == 0) radiance *= albedo;
#endif
  gl_Position = projected * vec4(where, 1.0);
}`;

const SHADING = TONE + `
uniform int back;
in float seen;
in vec3 radiance;
out vec4 colour;
#ifdef SHINES
in vec3 gloss;
#endif
#ifdef TEXTURED
uniform sampler2D albedos;
in vec2 texcoords;
#endif
void main() {
  if (back == 1 && seen <= 0.0) discard;
#ifdef TEXTURED
  vec3 leaving = radiance * texture(albedos, texcoords).rgb;
#else
  vec3 leaving = radiance;
#endif
#ifdef SHINES
  leaving += gloss;
#endif
  colour = seen > 0.0 ? shown(leaving) : vec4(0.0, 0.0, 0.0, 1.0); // one-sided surfaces are black from behind
}`;

const CLUSTER = 3; // the attribute that is read for colours of clusters alone
const ATTRIBUTES = [
  ["positions", "UNSIGNED_SHORT", 3, true],
  ["normals", "BYTE", 3, true],
  ["albedo", "UNSIGNED_SHORT", 3, true],
  ["clusterColours", "UNSIGNED_BYTE", 3, true],
  ["texcoords", "FLOAT", 2, false],
];

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
    const head = HEAD + (scene.shines ? "#define SHINES\n" : ""), textured = head + "#define TEXTURED\n";
    this.programs = {
      background: this.program(FILL, BACKGROUND),
      plain: this.program(head + SURFACE, head + SHADING),
      textured: this.program(textured + SURFACE, textured + SHADING),
    };
    this.size = [ROW, Math.ceil(scene.vertices / ROW)];
    if (scene.streamed) this.prepareStreamed();
    else this.prepareClusters();
    this.environments = new Map();
    this.albedos = scene.images.map((image) => this.image(image, gl.REPEAT));
    this.smooth = null;
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
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
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

  geometry() {
    const { gl, scene } = this;
    this.surfaces = gl.createVertexArray();
    gl.bindVertexArray(this.surfaces);
    ATTRIBUTES.forEach(([name, type, count, normalized], location) => {
      const values = scene.arrays[name];
      if (!values || !values.length) return;
      // rows of 3 small numbers are padded to 4 bytes: what drivers read as it is
      const own = count === 3 ? quadrupled(values) : values;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, own, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, count, gl[type], normalized, count === 3 ? 4 * own.BYTES_PER_ELEMENT : 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(scene.arrays.triangles), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.nothing = gl.createVertexArray();
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
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, ...this.size);
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // What the camera sees; smooth pictures have four samples in each pixel
  draw({ camera, light, degrees, exposure, brightness, kind, smooth: asked }) {
    const { gl, canvas } = this, most = gl.getParameter(gl.MAX_RENDERBUFFER_SIZE);
    const smooth = asked && 2 * Math.max(canvas.width, canvas.height) <= most;
    const scale = smooth ? 2 : 1, width = scale * canvas.width, height = scale * canvas.height;
    if (smooth) this.beginSmooth(width, height);
    gl.viewport(0, 0, width, height);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    const view = camera.matrices(width / height);
    this.drawSurfaces(view, exposure, kind);
    const { program, uniforms } = this.programs.background;
    gl.useProgram(program);
    const { radiance, image } = this.environment(light);
    this.bind(0, gl.TEXTURE_2D, radiance, uniforms.environment);
    this.bind(1, gl.TEXTURE_2D, image || radiance, uniforms.sharp);
    gl.uniform1i(uniforms.sharper, image ? 1 : 0);
    gl.uniformMatrix3fv(uniforms.towards, false, view.towards);
    gl.uniform1f(uniforms.degrees, degrees);
    gl.uniform1f(uniforms.exposure, exposure * brightness);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (smooth) this.endSmooth(width, height);
  }

  drawSurfaces(view, exposure, kind) {
    const { gl, scene } = this;
    gl.bindVertexArray(this.surfaces);
    if (kind === 2) gl.enableVertexAttribArray(CLUSTER);
    else gl.disableVertexAttribArray(CLUSTER);
    for (const name of ["plain", "textured"]) {
      const { program, uniforms } = this.programs[name];
      gl.useProgram(program);
      this.bind(0, gl.TEXTURE_2D, this.light, uniforms.light);
      gl.uniformMatrix4fv(uniforms.projected, false, view.projected);
      gl.uniform3fv(uniforms.low, scene.low);
      gl.uniform3fv(uniforms.extent, scene.extent);
      gl.uniform3fv(uniforms.eye, view.eye);
      gl.uniform1f(uniforms.exposure, exposure);
      gl.uniform1i(uniforms.kind, Math.min(kind, 2));
      if (scene.shines) this.bind(2, gl.TEXTURE_2D, this.shine, uniforms.shine);
      for (const mesh of scene.meshes)
        if ((mesh.texture !== null && kind === 0) === (name === "textured")) this.drawMesh(mesh, uniforms, kind);
    }
  }

  drawMesh(mesh, uniforms, kind) {
    const { gl, scene } = this;
    if (kind === 3) gl.vertexAttrib3fv(CLUSTER, scene.errors[mesh.name] ? scene.errors[mesh.name].colour : [0.2, 0.2, 0.2]);
    if (uniforms.albedos) this.bind(1, gl.TEXTURE_2D, this.albedos[mesh.texture], uniforms.albedos);
    gl.uniform1i(uniforms.back, mesh.back ? 1 : 0);
    if (mesh.back) gl.enable(gl.POLYGON_OFFSET_FILL); // it lies where its front lies
    gl.polygonOffset(-1, -1);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 4 * mesh.first);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  beginSmooth(width, height) {
    const { gl } = this;
    if (!this.smooth || this.smooth.width !== width || this.smooth.height !== height) {
      if (this.smooth) this.smooth.buffers.forEach((buffer) => gl.deleteRenderbuffer(buffer));
      const framebuffer = this.smooth ? this.smooth.framebuffer : gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      const buffers = [[gl.RGBA8, gl.COLOR_ATTACHMENT0], [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]].map(([kind, place]) => {
        const buffer = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
        gl.renderbufferStorage(gl.RENDERBUFFER, kind, width, height);
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
        return buffer;
      });
      this.smooth = { framebuffer, buffers, width, height };
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.smooth.framebuffer);
  }

  endSmooth(width, height) {
    const { gl } = this;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.smooth.framebuffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    // linear, at half the size: the mean of 2 x 2
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width / 2, height / 2, gl.COLOR_BUFFER_BIT, gl.LINEAR);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
}

function padded(values, length) {
  const result = new values.constructor(length);
  result.set(values);
  return result;
}

function quadrupled(values) {
  const result = new values.constructor((4 * values.length) / 3);
  for (let k = 0; 3 * k < values.length; k++) for (let c = 0; c < 3; c++) result[4 * k + c] = values[3 * k + c];
  return result;
}
