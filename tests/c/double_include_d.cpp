// The three headers may be included several times in one file and in several files: nothing is defined twice.
#include <entire/entire.hpp>

extern "C" unsigned version_in_a(void);
extern "C" unsigned version_in_b(void);
const char *message_in_c();

int main() {
    const auto result = entire::model::open("no such file");
    const bool same = result.message() == message_in_c() && result.code() == ENTIRE_IO;
    return version_in_a() == version_in_b() && same ? 0 : 1;
}
