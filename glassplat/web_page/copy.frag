// Shows what was drawn small in the whole window.
uniform sampler2D image;
uniform vec2 size, used;
out vec4 shown;

void main() { shown = texture(image, min(gl_FragCoord.xy / size * used, used - 0.5 / size)); }
