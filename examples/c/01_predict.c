/* Reads a model file, prints its inputs, and predicts a frame's time for several ray steps: one at a time, then all in
 * one call.
 *
 *   01_predict MODEL.safetensors
 */
#include <entire/advanced.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void check(entire_result result) {
    if (result != ENTIRE_OK) {
        fprintf(stderr, "%s: %s\n", entire_result_name(result), entire_last_error());
        exit(1);
    }
}

/* Writes the inputs of one group to `at`. Inputs of groups with other names stay 0. */
static void fill(const entire_input_group *group, float *at, float step) {
    static const float camera[3] = {20, -30, 3}, lobe[3] = {0.6f, 0.02f, 0.4f};
    if (strcmp(group->name, "camera") == 0) memcpy(at, camera, sizeof camera);
    if (strcmp(group->name, "resolution") == 0) at[0] = 512, at[1] = 512;
    if (strcmp(group->name, "transfer_function") == 0)
        for (size_t i = 0; i < group->size; ++i) at[i] = lobe[i % 3];
    if (strcmp(group->name, "step_size") == 0) at[0] = step;
}

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: %s MODEL.safetensors\n", argv[0]), 2;

    entire_model *model = NULL;
    check(entire_model_open(argv[1], &model));
    const char *device = entire_model_metadata(model, "entire.device");
    printf("model for %s, run with %s\n", device ? device : "an unnamed device", entire_simd_level());

    entire_model_info info = {.struct_size = sizeof info};
    check(entire_model_describe(model, &info));
    if (info.input_count == 0) return fprintf(stderr, "the file has no prediction network\n"), 1;

    enum { ROWS = 4 };
    float *inputs = calloc(ROWS * info.input_count, sizeof *inputs), seconds[ROWS];
    if (!inputs) return 1;
    for (size_t row = 0; row < ROWS; ++row)
        for (size_t i = 0; i < info.group_count; ++i) {
            entire_input_group group = {.struct_size = sizeof group};
            check(entire_model_input_group(model, i, &group));
            if (row == 0) printf("  inputs %2zu..%-2zu %s\n", group.offset, group.offset + group.size - 1, group.name);
            fill(&group, inputs + row * info.input_count + group.offset, (float)(1u << row));
        }

    for (size_t row = 0; row < ROWS; ++row) {
        check(entire_model_predict(model, inputs + row * info.input_count, info.input_count, &seconds[row]));
        printf("step %2u: %8.3f ms\n", 1u << row, 1e3 * seconds[row]);
    }
    check(entire_model_predict_batch(model, inputs, ROWS, info.input_count, seconds));
    printf("all at once: %.3f %.3f %.3f %.3f ms\n", 1e3 * seconds[0], 1e3 * seconds[1], 1e3 * seconds[2],
           1e3 * seconds[3]);

    free(inputs);
    entire_model_free(model);
    return 0;
}
