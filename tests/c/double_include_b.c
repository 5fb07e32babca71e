#include <entire/advanced.h>
#include <entire/entire.h>

unsigned version_in_b(void) {
    return entire_version_number();
}
