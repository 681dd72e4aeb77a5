// What of three.js the pages use. `three.min.js` is made of this by
//   npm install three@0.187.0 esbuild
//   npx esbuild three_entry.js --bundle --minify --format=iife --global-name=THREE \
//     --target=es2020 --legal-comments=none --outfile=three.min.js
// with the version and the text of three.LICENSE put before it as a comment: /*! ... */
export {
  AmbientLight, BufferAttribute, BufferGeometry, CanvasTexture, Color, DoubleSide, FrontSide,
  Group, InstancedBufferAttribute, InstancedBufferGeometry, LineBasicMaterial, LineSegments,
  Matrix4, Mesh, MeshBasicMaterial, MeshMatcapMaterial, PerspectiveCamera, PlaneGeometry,
  Quaternion, Raycaster, Scene, ShaderMaterial, SphereGeometry, SRGBColorSpace, Texture,
  Vector2, Vector3, WebGLRenderer,
} from 'three';
export { OrbitControls } from 'three/addons/controls/OrbitControls.js';
export { LineSegments2 } from 'three/addons/lines/LineSegments2.js';
export { LineSegmentsGeometry } from 'three/addons/lines/LineSegmentsGeometry.js';
export { LineMaterial } from 'three/addons/lines/LineMaterial.js';
