/* Runs a model and a session through the C library, for comparison with Rust (ffi/tests/suite/parity.rs): reads rows of
 * inputs as raw floats from standard input, writes raw floats: a prediction per row, then the volume's features, then
 * the seconds and the step of plans around an orbit.
 *
 *   parity MODEL COLUMNS < inputs > outputs
 */
#include "check.h"

int main(int argc, char **argv) {
    CHECK(argc == 3);
    const size_t columns = strtoul(argv[2], NULL, 10);
    entire_model *model = NULL;
    OK(entire_model_open(argv[1], &model));
    float *row = malloc(columns * sizeof *row);
    CHECK(row != NULL);
    while (fread(row, sizeof *row, columns, stdin) == columns) {
        float seconds = 0;
        OK(entire_model_predict(model, row, columns, &seconds));
        CHECK(fwrite(&seconds, sizeof seconds, 1, stdout) == 1);
    }
    free(row);

    entire_volume *volume = toy_volume();
    float features[2];
    size_t count = 0;
    OK(entire_model_encode(model, volume, features, 2, &count));
    CHECK(fwrite(features, sizeof features[0], count, stdout) == count);
    entire_volume_free(volume);

    entire_session *session = toy_session(model);
    entire_frame frame = toy_frame();
    for (int i = 0; i < 50; ++i) {
        entire_plan plan = {.struct_size = sizeof plan};
        frame.arcball[0] = (float)i;
        frame.arcball[1] = 7 * (float)i;
        OK(entire_session_plan(session, &frame, 0.004f, &plan));
        const float out[2] = {plan.seconds, plan.step};
        CHECK(fwrite(out, sizeof out[0], 2, stdout) == 2);
        OK(entire_session_observe(session, plan.id, 0.001f + 0.01f / plan.step, 0, NULL));
    }
    entire_session_free(session);
    entire_model_free(model);
    return 0;
}
