// As names.h, for C++ blocks.
#include <entire/entire.hpp>

extern const entire::volume &volume;
extern float rx, ry, distance;
extern std::uint32_t width, height;
extern const entire::transfer_function &transfer_function;
float draw(double step);
