#include <entire/entire.h>
#include <entire/entire.h>

unsigned version_in_a(void) {
    return ENTIRE_VERSION_NUMBER;
}
