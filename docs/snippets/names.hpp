// As names.h, for C++ blocks.
#include <entire/entire.hpp>

extern const entire::volume &volume;
extern float rx, ry, distance;
extern std::uint32_t width, height;
void draw(double step);
