/* Names that the code blocks of README.md and the book use without declaring them. lab/scripts/house.py compiles each C
 * and C++ block inside a function after this. */
#include <entire/advanced.h>

extern const uint16_t *voxels;
extern size_t nx, ny, nz, opacity_count, color_count;
extern const entire_opacity_node *opacity;
extern const entire_color_node *color;
extern float low, high, rx, ry, distance_in_radii, smallest_spacing, seconds, frame_seconds, finest_step;
extern uint32_t width, height;
extern entire_frame frame;
extern entire_plan plan;
#ifndef __cplusplus
extern entire_session *session;
extern entire_volume *volume;
double draw(double step);
#endif
