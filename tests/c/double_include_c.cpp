#include <entire/entire.hpp>
#include <entire/entire.h>
#include <entire/entire.hpp>

const char *message_in_c() {
    static const auto result = entire::model::open("no such file");
    return result.message().c_str();
}
