// --- WebGL 2: programs, textures, and how radiance is shown

const HEAD = "#version 300 es\nprecision highp float; precision highp int; precision highp sampler2D;\n";

const FILL = HEAD + `
out vec2 place;
void main() {
  place = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0;
  gl_Position = vec4(place, 1.0, 1.0);
}`;

// sRGB by square roots, to within 1e-4 of its powers (least squares), which take twice as long without a graphics card
const TONE = `
uniform float exposure;
vec4 shown(vec3 radiance) {
  vec3 x = clamp(radiance * exposure, 0.0, 1.0), a = sqrt(x), b = sqrt(a), c = sqrt(b);
  vec3 curve = 0.64456067 * a + 0.70994555 * b - 0.33605156 * c - 0.01848596 * x;
  return vec4(mix(12.92 * x, curve, step(0.0031308, x)), 1.0);
}`;

class Drawing {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!this.gl) throw new Error("This page needs WebGL 2, which this browser does not have or does not allow.");
  }

  program(vertices, fragments) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, fragments]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error("A shader does not compile: " + gl.getProgramInfoLog(program));
    const uniforms = {};
    for (let k = 0; k < (gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0); k++) {
      const { name } = gl.getActiveUniform(program, k);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  texture(kind, width, height, format, type, values) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, kind, width, height, 0, format, type, values);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return texture;
  }

  bind(unit, kind, texture, uniform) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, texture);
    gl.uniform1i(uniform, unit);
    gl.activeTexture(gl.TEXTURE0);
  }
}
