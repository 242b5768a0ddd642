/** The room: renderer, camera, sky, floor, light. In AR the room is the real one. */

import {
  BackSide,
  CircleGeometry,
  Color,
  Group,
  HemisphereLight,
  Mesh,
  PerspectiveCamera,
  Scene,
  ShaderMaterial,
  SphereGeometry,
  Vector3,
  WebGLRenderer,
} from "../vendor/three.js";

/** The colours of all that is drawn, as the page's dark scheme has them. */
export const COLOURS = {
  sky: 0x16233a,
  horizon: 0x3a5a86,
  ground: 0x0a0e15,
  panel: "#121922",
  raised: "#1b2531",
  border: "#2f3c4b",
  text: "#e8edf3",
  muted: "#9dabb9",
  accent: "#5cadff",
  good: "#4cc38a",
  warn: "#f2c94c",
  bad: "#ff8a80",
  stop: "#d92d20",
};

/** Whether edges and text are drawn finely: where there are two processors, they draw it all. */
export const FINE = (navigator.hardwareConcurrency ?? 8) > 2;

const EYES_M = 1.6;
const FLOOR_M = 24;

const SKY = {
  vertex: `varying vec3 at; void main() { at = position; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
  fragment: `
    varying vec3 at; uniform vec3 sky; uniform vec3 horizon; uniform vec3 ground;
    void main() {
      float up = normalize(at).y;
      vec3 above = mix(horizon, sky, pow(clamp(up, 0.0, 1.0), 0.45));
      vec3 colour = up > 0.0 ? above : mix(horizon, ground, pow(clamp(-up, 0.0, 1.0), 0.22));
      gl_FragColor = vec4(colour, 1.0);
      #include <colorspace_fragment>
    }`,
};

const FLOOR = {
  vertex: `varying vec2 at; void main() { at = position.xy; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
  fragment: `
    varying vec2 at; uniform vec3 line; uniform float reach;
    float lines(float every, float width) {
      vec2 off = abs(fract(at / every - 0.5) - 0.5) * every;
      vec2 soft = fwidth(at) * 0.75 + width;
      vec2 hit = 1.0 - smoothstep(vec2(width), width + soft, off);
      return max(hit.x, hit.y);
    }
    void main() {
      float far = length(at) / reach;
      float grid = max(lines(1.0, 0.004) * 0.55, lines(5.0, 0.008));
      gl_FragColor = vec4(line, grid * 0.5 * pow(1.0 - clamp(far, 0.0, 1.0), 1.6));
      #include <colorspace_fragment>
    }`,
};

export class Stage {
  constructor(canvas) {
    this.renderer = new WebGLRenderer({ canvas, antialias: FINE, alpha: true, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio || 1));
    this.renderer.xr.enabled = true;
    this.renderer.xr.setReferenceSpaceType("local-floor");
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(62, 1, 0.05, 80);
    this.camera.layers.enable(1); // on a screen the left eye's pictures
    /** How somebody at a screen looks about, in radians. */
    this.look = { yaw: 0, pitch: -0.12 };
    this.room = new Group();
    this.room.add(sky(), floor());
    this.scene.add(this.room, new HemisphereLight(0xdce8ff, 0x1a2230, 2.4));
    this.resize();
    addEventListener("resize", () => this.resize());
  }

  /** Whether the browser has taken the graphics away: then nothing is drawn, without an error. */
  get lost() {
    return this.renderer.getContext().isContextLost();
  }

  get immersive() {
    return this.renderer.xr.isPresenting;
  }

  /** In AR there is nothing between who looks and where he is. */
  setReal(real) {
    this.room.visible = !real;
  }

  setImmersive(immersive) {
    if (immersive) this.camera.layers.disable(1);
    else this.camera.layers.enable(1);
    if (!immersive) this.resize();
  }

  resize() {
    if (this.immersive) return;
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.fov = width < height ? 84 : 62;
    this.camera.updateProjectionMatrix();
  }

  render() {
    if (!this.immersive) {
      this.camera.position.set(0, EYES_M, 0.55);
      this.camera.rotation.set(this.look.pitch, this.look.yaw, 0, "YXZ");
    }
    this.renderer.render(this.scene, this.camera);
  }

  /** Where the head is, in the scene: {position, facing}, facing in radians to the left of -z. */
  head() {
    const { elements: m } = this.camera.matrixWorld;
    return { position: new Vector3(m[12], m[13], m[14]), facing: Math.atan2(m[8], m[10]) };
  }
}

function sky() {
  const uniforms = {
    sky: { value: new Color(COLOURS.sky) },
    horizon: { value: new Color(COLOURS.horizon) },
    ground: { value: new Color(COLOURS.ground) },
  };
  const material = new ShaderMaterial({
    uniforms,
    vertexShader: SKY.vertex,
    fragmentShader: SKY.fragment,
    side: BackSide,
    depthWrite: false,
  });
  const mesh = new Mesh(new SphereGeometry(60, 32, 20), material);
  mesh.renderOrder = -2;
  return mesh;
}

function floor() {
  const uniforms = { line: { value: new Color(0x7fa3d0) }, reach: { value: FLOOR_M } };
  const material = new ShaderMaterial({
    uniforms,
    vertexShader: FLOOR.vertex,
    fragmentShader: FLOOR.fragment,
    transparent: true,
    depthWrite: false,
  });
  const mesh = new Mesh(new CircleGeometry(FLOOR_M, 48), material);
  mesh.rotation.x = -Math.PI / 2;
  mesh.renderOrder = -1;
  return mesh;
}
