precision highp float;
precision highp int;
precision highp usampler2D;

const int ROW = 1024;

ivec2 texel(int index) { return ivec2(index % ROW, index / ROW); }

vec4 bytesOf(uint word) { return vec4(uvec4(word, word >> 8u, word >> 16u, word >> 24u) & 255u); }
