// Where two pictures differ: what the canvas shows of each is kept, and the difference is coloured.

import {
  Color,
  FramebufferTexture,
  Mesh,
  NearestFilter,
  NoColorSpace,
  OrthographicCamera,
  PlaneGeometry,
  Scene,
  ShaderMaterial,
  Vector2,
} from "three";

// Matplotlib's inferno (CC0) at equal distances: of two colours the brighter one is the larger error.
const COLOURS = [
  "#000004",
  "#1f0c48",
  "#550f6d",
  "#88226a",
  "#ba3655",
  "#e35933",
  "#f98c0a",
  "#f9c932",
  "#fcffa4",
];
// The difference of luma, of full brightness, that has the last colour. The square root of the
// difference chooses the colour, or all but the worst places would look black.
const MOST = 0.25;
const MARKS = [0, 0.01, 0.04, 0.09, 0.16, 0.25];

// What a legend needs: colours at equal distances, and where along them which difference lies.
export const SCALE = {
  colours: COLOURS,
  marks: MARKS.map((difference) => ({ difference, place: Math.sqrt(difference / MOST) })),
};

const VERTEX = "void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }";
const FRAGMENT = `
  uniform sampler2D one, other;
  uniform vec3 colours[${COLOURS.length}];
  void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec3 apart = texelFetch(one, at, 0).rgb - texelFetch(other, at, 0).rgb;
    float luma = abs(dot(apart, vec3(0.2126, 0.7152, 0.0722)));
    float place = min(sqrt(luma / ${MOST}), 1.0) * ${(COLOURS.length - 1).toFixed(1)};
    int below = min(int(place), ${COLOURS.length - 2});
    gl_FragColor = vec4(mix(colours[below], colours[below + 1], place - float(below)), 1.0);
  }`;

export function makeHeat(renderer) {
  const kept = [null, null];
  const size = new Vector2();
  const uniforms = {
    one: { value: null },
    other: { value: null },
    colours: { value: COLOURS.map((colour) => new Color().setStyle(colour, NoColorSpace)) },
  };
  const material = new ShaderMaterial({
    uniforms,
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    depthTest: false,
    depthWrite: false,
  });
  const quad = new Mesh(new PlaneGeometry(2, 2), material);
  quad.frustumCulled = false;
  const scene = new Scene();
  scene.add(quad);
  const camera = new OrthographicCamera();

  // Copied from the canvas, and not drawn into a texture: there Spark would blend linear colours.
  function keep(side) {
    renderer.getDrawingBufferSize(size);
    const texture = kept[side];
    if (!texture || texture.image.width !== size.x || texture.image.height !== size.y) {
      texture?.dispose();
      kept[side] = new FramebufferTexture(size.x, size.y);
      kept[side].minFilter = kept[side].magFilter = NearestFilter;
    }
    renderer.copyFramebufferToTexture(kept[side]);
  }

  function paint() {
    [uniforms.one.value, uniforms.other.value] = kept;
    renderer.render(scene, camera);
  }
  return { keep, paint };
}
