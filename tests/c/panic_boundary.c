/* A panic inside the library is a code, its place is in the text, and its handle then refuses everything but free. Needs
 * a library built with the feature `test-panic`. */
#include "check.h"

entire_result entire_test_panic(entire_predictor *predictor);

int main(void) {
    entire_predictor *predictor = toy_predictor(NULL), *other = toy_predictor(NULL);
    EXPECT(ENTIRE_PANIC, entire_test_panic(predictor));
    SAYS("a bug in the library");
    SAYS("predictor.rs:");
    EXPECT(ENTIRE_PANIC, entire_predictor_reset(predictor));
    SAYS("earlier call panicked inside this entire_predictor");
    entire_frame frame = toy_frame();
    entire_plan plan = {.struct_size = sizeof plan};
    EXPECT(ENTIRE_PANIC, entire_predictor_plan(predictor, &frame, 0.01f, &plan));
    size_t size = 0;
    EXPECT(ENTIRE_PANIC, entire_predictor_save_state(predictor, NULL, 0, &size));
    char text[300];
    OK(entire_predictor_last_error(predictor, text, sizeof text, NULL));
    CHECK(strstr(text, "earlier call panicked"));
    entire_predictor_free(predictor);
    OK(entire_predictor_plan(other, &frame, 0.01f, &plan));
    entire_predictor_free(other);
    return 0;
}
