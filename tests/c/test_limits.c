/* Sizes beyond the limits are refused before anything is allocated or scanned; a model's output that is not a frame
 * time is never returned with ENTIRE_OK. */
#include "check.h"
#include <math.h>

static void volume_sizes(void) {
    static const float voxel[1] = {0};
    const size_t sides[] = {513, 200000, ENTIRE_MAX_SIDE, (size_t)1 << 21, SIZE_MAX / 3, SIZE_MAX};
    const entire_scalar_type types[] = {ENTIRE_SCALAR_U8, ENTIRE_SCALAR_U16, ENTIRE_SCALAR_I16, ENTIRE_SCALAR_F32};
    for (size_t i = 0; i < sizeof sides / sizeof sides[0]; ++i)
        for (size_t k = 0; k < 8; ++k) {
            entire_volume_desc desc;
            entire_volume *none = NULL;
            OK(entire_volume_desc_init(&desc, sizeof desc));
            desc.scalar_type = types[k / 2];
            desc.ownership = k % 2 ? ENTIRE_VOXELS_BORROW : ENTIRE_VOXELS_COPY;
            desc.voxels = voxel;
            desc.voxel_count = 1;
            for (int a = 0; a < 3; ++a) desc.dims[a] = sides[i], desc.strides[a] = 0;
            EXPECT(ENTIRE_SIZE_MISMATCH, entire_volume_new(&desc, &none));
            SAYS(sides[i] > ENTIRE_MAX_SIDE ? "ENTIRE_MAX_SIDE" : "ENTIRE_MAX_REPEATED_VOXELS");
            /* Only one long axis. */
            desc.dims[1] = desc.dims[2] = 1;
            const entire_result alone = entire_volume_new(&desc, &none);
            CHECK(alone == (sides[i] > ENTIRE_MAX_SIDE ? ENTIRE_SIZE_MISMATCH : ENTIRE_OK));
            entire_volume_free(none);
        }

    /* A repeated voxel within the limit is a volume like any other. */
    entire_volume_desc desc;
    entire_volume *constant = NULL;
    OK(entire_volume_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.voxels = voxel;
    desc.voxel_count = 1;
    for (int a = 0; a < 3; ++a) desc.dims[a] = 40, desc.strides[a] = 0;
    OK(entire_volume_new(&desc, &constant));
    entire_session *session = NULL;
    OK(entire_session_new(NULL, NULL, &session));
    OK(entire_session_set_volume(session, constant));
    entire_session_free(session);
    entire_volume_free(constant);
}

static void brick_sizes(void) {
    const float bounds[2] = {0, 1};
    entire_brick_desc good;
    OK(entire_brick_desc_init(&good, sizeof good));
    good.scalar_type = ENTIRE_SCALAR_U8;
    for (int a = 0; a < 3; ++a) good.dims[a] = good.brick_edge[a] = 64;
    good.bounds = bounds;
    good.brick_count = 1;
    entire_volume *volume = NULL;
    OK(entire_volume_from_bricks(&good, &volume));
    entire_volume_free(volume);
    volume = NULL;
    entire_brick_desc bad = good;
    bad.dims[1] = (size_t)ENTIRE_MAX_SIDE + 1;
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_volume_from_bricks(&bad, &volume));
    SAYS("ENTIRE_MAX_SIDE");
    bad = good;
    bad.brick_count = (size_t)ENTIRE_MAX_BRICKS + 1;
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_volume_from_bricks(&bad, &volume));
    SAYS("ENTIRE_MAX_BRICKS");
    bad = good;
    for (int a = 0; a < 3; ++a) bad.dims[a] = (size_t)1 << 20, bad.brick_edge[a] = 1;
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_volume_from_bricks(&bad, &volume));
    CHECK(volume == NULL);
}

/* Counts beyond the limits are refused before the array is read: each array here has only one element. */
static void counts(const char *path) {
    entire_transfer_function *tf = NULL;
    const size_t points = (size_t)ENTIRE_MAX_TRANSFER_POINTS + 1;
    const entire_gaussian_lobe lobe = {0.5f, 0.1f, 0.1f};
    const entire_opacity_node opacity = {0, 0, 0.5, 0};
    const entire_color_node color = {0, {0, 0, 0}, 0.5, 0};
    const float rgba[4] = {0, 0, 0, 0};
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_from_lobes(&lobe, points, &tf));
    SAYS("ENTIRE_MAX_TRANSFER_POINTS");
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_from_nodes(&opacity, points, &color, 1, 0, 1, 1, &tf));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_from_nodes(&opacity, 1, &color, points, 0, 1, 1, &tf));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_from_table(rgba, points, &tf));
    CHECK(tf == NULL);

    entire_volume *volume = toy_volume();
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_volume_set_features(volume, rgba, (size_t)ENTIRE_MAX_FEATURES + 1));
    SAYS("ENTIRE_MAX_FEATURES");
    entire_volume_free(volume);

    entire_model *model = NULL;
    const uint8_t byte = 0;
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_from_bytes(&byte, (size_t)ENTIRE_MAX_MODEL_BYTES + 1, &model));
    SAYS("ENTIRE_MAX_MODEL_BYTES");
    OK(entire_model_open(path, &model));
    entire_model_free(model);

    entire_session *session = toy_session(NULL);
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_session_load_state(session, &byte, (size_t)ENTIRE_MAX_STATE_BYTES + 1));
    SAYS("ENTIRE_MAX_STATE_BYTES");
    entire_session_free(session);
}

/* Returns the toy model, with all floats of one tensor replaced by `value`. */
static entire_model *with_tensor(const char *path, const char *tensor, float value) {
    size_t size = 0;
    uint8_t *bytes = read_file(path, &size);
    uint64_t header = 0;
    for (int i = 7; i >= 0; --i) header = header << 8 | bytes[i];
    char *text = malloc((size_t)header + 1);
    CHECK(text != NULL);
    memcpy(text, bytes + 8, (size_t)header);
    text[header] = '\0';
    char quoted[80];
    snprintf(quoted, sizeof quoted, "\"%s\":", tensor);
    const char *entry = strstr(text, quoted);
    CHECK(entry != NULL);
    CHECK(strstr(entry, "\"F32\"") - entry < 60);
    const char *offsets = strchr(strstr(entry, "\"data_offsets\""), '[');
    CHECK(offsets != NULL);
    char *end = NULL;
    const unsigned long from = strtoul(offsets + 1, &end, 10), to = strtoul(end + 1, NULL, 10);
    CHECK(from < to && 8 + header + to <= size);
    for (unsigned long at = from; at < to; at += sizeof value)
        memcpy(bytes + 8 + header + at, &value, sizeof value);
    entire_model *model = NULL;
    OK(entire_model_from_bytes(bytes, size, &model));
    free(text);
    free(bytes);
    return model;
}

/* Checks that every result of a call that returns ENTIRE_OK is a frame time or is marked as absent, whatever the
 * model's output. Returns the number of refused calls. */
static long answers(const entire_model *model) {
    enum { COLUMNS = 11, ROWS = 7 };
    long refused = 0;
    float inputs[ROWS * COLUMNS], together[ROWS];
    for (int row = 0; row < ROWS; ++row) {
        const float values[COLUMNS] = {0.1f, -0.2f, 20, (float)row, 3, 256, 128, 0.5f, 0.02f, 0.4f, 1 + 0.05f * (float)row};
        memcpy(inputs + row * COLUMNS, values, sizeof values);
    }
    for (int row = 0; row < ROWS; ++row) {
        float seconds = 42;
        const entire_result one = entire_model_predict(model, inputs + row * COLUMNS, COLUMNS, &seconds);
        CHECK(one == ENTIRE_OK || one == ENTIRE_INVALID_MODEL);
        CHECK(one == ENTIRE_OK ? seconds > 0 && seconds < 1e9f : seconds == 42);
        refused += one != ENTIRE_OK;
    }
    for (int row = 0; row < ROWS; ++row) together[row] = 42;
    const entire_result all = entire_model_predict_batch(model, inputs, ROWS, COLUMNS, together);
    CHECK(all == ENTIRE_OK || all == ENTIRE_INVALID_MODEL);
    for (int row = 0; row < ROWS; ++row)
        CHECK(all == ENTIRE_OK ? together[row] > 0 && together[row] < 1e9f : together[row] == 42);
    refused += all != ENTIRE_OK;

    entire_session *session = toy_session(model);
    entire_frame frame = toy_frame();
    const entire_setting settings[] = {{1, 96, 64, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS},
                                       {4, 48, 32, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS}};
    for (int i = 0; i < 40; ++i) {
        frame.arcball[1] = (float)(i * 9);
        entire_prediction prediction = {.struct_size = sizeof prediction, .seconds = 42};
        const entire_result predicted = entire_session_predict(session, &frame, &prediction);
        CHECK(predicted == ENTIRE_OK || predicted == ENTIRE_INVALID_MODEL);
        CHECK(predicted == ENTIRE_OK ? prediction.seconds > 0 && prediction.seconds < 1e9f : prediction.seconds == 42);
        CHECK(!isinf(prediction.upper) && !(prediction.upper < 0));

        entire_plan plan = {.struct_size = sizeof plan};
        size_t index = 9;
        const entire_result planned =
            i % 4 == 3 ? entire_session_choose(session, &frame, settings, 2, 0.02f, &index, &plan)
                       : entire_session_plan(session, &frame, 0.02f, &plan);
        CHECK(planned == ENTIRE_OK || planned == ENTIRE_INVALID_MODEL);
        if (planned != ENTIRE_OK) {
            CHECK(plan.id == 0 && index == 9);
            refused += 1;
            continue;
        }
        CHECK(plan.step >= 1 && plan.step <= 16);
        if (plan.absent & ENTIRE_ABSENT_SECONDS) CHECK(isnan(plan.seconds));
        else CHECK(plan.seconds > 0 && plan.seconds < 1e9f);
        CHECK((plan.absent & ENTIRE_ABSENT_UPPER) ? isnan(plan.upper) : plan.upper > 0 && plan.upper < 1e9f);
        OK(entire_session_observe(session, plan.id, 0.005f + 0.05f / plan.step, 0, NULL));
    }
    entire_session_free(session);
    return refused;
}

static void hostile_weights(const char *path) {
    entire_model *plain = NULL;
    OK(entire_model_open(path, &plain));
    CHECK(answers(plain) == 0);
    entire_model_free(plain);

    const char *tensors[] = {"prednet.0.bias",   "prednet.0.weight",    "prednet.1.weight",  "prednet.2.bias",
                             "prednet.2.weight", "prednet.output.mean", "prednet.output.std"};
    const float values[] = {1e4f, -1e4f, 1e20f, -1e20f, 3e38f, -3e38f};
    long refused = 0;
    for (size_t t = 0; t < sizeof tensors / sizeof tensors[0]; ++t)
        for (size_t v = 0; v < sizeof values / sizeof values[0]; ++v) {
            if (strcmp(tensors[t], "prednet.output.std") == 0 && values[v] < 0) continue;
            entire_model *model = with_tensor(path, tensors[t], values[v]);
            refused += answers(model);
            entire_model_free(model);
        }
    /* Without the library's check, these calls would return seconds that are infinite, NaN or at least 1e9. */
    CHECK(refused > 20);
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    volume_sizes();
    brick_sizes();
    counts(argv[1]);
    hostile_weights(argv[1]);
    return 0;
}
