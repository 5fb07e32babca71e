/* A panic inside the library becomes an error code, and the error text names its source line. The handle of the call
 * then refuses all calls except free. Needs a library built with the feature `test-panic`. */
#include "check.h"

entire_result entire_test_panic(entire_session *session);

int main(void) {
    entire_session *session = toy_session(NULL), *other = toy_session(NULL);
    EXPECT(ENTIRE_PANIC, entire_test_panic(session));
    SAYS("a bug in the library");
    SAYS("session/mod.rs:");
    EXPECT(ENTIRE_PANIC, entire_session_reset(session));
    SAYS("earlier call panicked inside this entire_session");
    entire_frame frame = toy_frame();
    entire_plan plan = {.struct_size = sizeof plan};
    EXPECT(ENTIRE_PANIC, entire_session_plan(session, &frame, 0.01f, &plan));
    size_t size = 0;
    EXPECT(ENTIRE_PANIC, entire_session_save_state(session, NULL, 0, &size));
    entire_session_free(session);
    OK(entire_session_plan(other, &frame, 0.01f, &plan));
    entire_session_free(other);
    return 0;
}
