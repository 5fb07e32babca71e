/* entire_model: reading, describing, predicting, encoding, and every way in which they fail. */
#define _XOPEN_SOURCE 700
#include "check.h"
#include <math.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

static entire_model *open_toy(const char *path) {
    entire_model *model = NULL;
    OK(entire_model_open(path, &model));
    CHECK(model != NULL);
    return model;
}

static entire_model_info info_of(const entire_model *model) {
    entire_model_info info = {.struct_size = sizeof info};
    OK(entire_model_describe(model, &info));
    return info;
}

static void descriptions(const entire_model *model) {
    entire_model_info info = info_of(model);
    CHECK(info.input_count == 11 && info.group_count == 5 && info.scene_feature_count == 0);
    CHECK(info.feature_count == 2 && info.encoder_edge == 16 && info.target == ENTIRE_TARGET_LOG_SECONDS);

    const char *names[] = {"volume_features", "camera", "resolution", "transfer_function", "step_size"};
    size_t offset = 0;
    for (size_t i = 0; i < info.group_count; ++i) {
        entire_input_group group = {.struct_size = sizeof group};
        OK(entire_model_input_group(model, i, &group));
        CHECK(strcmp(group.name, names[i]) == 0 && group.offset == offset);
        offset += group.size;
    }
    CHECK(offset == info.input_count);
    entire_input_group group = {.struct_size = sizeof group, .size = 99};
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_input_group(model, info.group_count, &group));
    CHECK(group.size == 99);
    group.struct_size = 3;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_model_input_group(model, 0, &group));
    info.struct_size = 0;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_model_describe(model, &info));

    CHECK(strcmp(entire_model_metadata(model, "entire.target"), "log_seconds") == 0);
    CHECK(strstr(entire_model_metadata(model, "entire.renderer"), "toy") != NULL);
    CHECK(entire_model_metadata(model, "no such key") == NULL && entire_last_error()[0] == '\0');
    CHECK(entire_model_metadata(model, "\xff") == NULL);
    SAYS("UTF-8");
    CHECK(entire_model_scene_feature(model, 0) == NULL);
}

static void predictions(const entire_model *model) {
    enum { COLUMNS = 11, ROWS = 300 };
    static float inputs[ROWS * COLUMNS], together[ROWS];
    for (int row = 0; row < ROWS; ++row) {
        const float values[COLUMNS] = {0.1f, -0.2f, 20, (float)row, 3, 256, 128, 0.5f, 0.02f, 0.4f, 1 + 0.05f * (float)row};
        memcpy(inputs + row * COLUMNS, values, sizeof values);
    }
    OK(entire_model_predict_batch(model, inputs, ROWS, COLUMNS, together));
    for (int row = 0; row < ROWS; ++row) {
        float alone = -1;
        OK(entire_model_predict(model, inputs + row * COLUMNS, COLUMNS, &alone));
        CHECK(isfinite(alone) && alone > 0);
        CHECK(fabsf(alone - together[row]) <= 1e-5f * alone);
    }
    OK(entire_model_predict_batch(model, NULL, 0, COLUMNS, NULL));

    float seconds = 42;
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_predict(model, inputs, COLUMNS - 1, &seconds));
    SAYS("takes 11");
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_predict(model, NULL, 0, &seconds));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_predict(model, inputs, SIZE_MAX / 2, &seconds));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_predict_batch(model, inputs, SIZE_MAX, SIZE_MAX, &seconds));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_predict_batch(model, inputs, 1, COLUMNS + 1, &seconds));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_predict(model, (const float *)((const char *)inputs + 1), COLUMNS, &seconds));
    SAYS("aligned");
    inputs[5 * COLUMNS + 3] = NAN;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_predict(model, inputs + 5 * COLUMNS, COLUMNS, &seconds));
    CHECK(seconds == 42);
    together[0] = together[7] = 42;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_predict_batch(model, inputs, ROWS, COLUMNS, together));
    SAYS("input 3 of row 5");
    CHECK(together[0] == 42 && together[7] == 42);
    inputs[5 * COLUMNS + 3] = -INFINITY;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_predict(model, inputs + 5 * COLUMNS, COLUMNS, &seconds));
}

static void encodings(const entire_model *model) {
    entire_volume *volume = toy_volume();
    float a[4] = {7, 7, 7, 7}, b[2];
    size_t count = 0;
    OK(entire_model_encode(model, volume, a, 4, &count));
    CHECK(count == 2 && a[2] == 7 && isfinite(a[0]) && isfinite(a[1]));
    OK(entire_model_encode(model, volume, b, 2, &count));
    CHECK(memcmp(a, b, sizeof b) == 0);
    count = 99;
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_encode(model, volume, a, 1, &count));
    CHECK(count == 99);
    entire_volume_free(volume);

    const float bounds[2] = {0, 1};
    entire_brick_desc desc;
    OK(entire_brick_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.dims[0] = desc.dims[1] = desc.dims[2] = desc.brick_edge[0] = desc.brick_edge[1] = desc.brick_edge[2] = 8;
    desc.bounds = bounds;
    desc.brick_count = 1;
    OK(entire_volume_from_bricks(&desc, &volume));
    EXPECT(ENTIRE_NOT_READY, entire_model_encode(model, volume, a, 4, &count));
    entire_volume_free(volume);
}

/* Opens the toy file with every occurrence of `from` replaced by `to`, which is as long. Returns the result. */
static entire_result altered(const char *path, const char *from, const char *to, entire_model **model) {
    size_t size = 0, n = strlen(from), found = 0;
    char *bytes = read_file(path, &size);
    CHECK(n == strlen(to));
    for (size_t i = 0; i + n <= size; ++i)
        if (memcmp(bytes + i, from, n) == 0) {
            memcpy(bytes + i, to, n);
            found += 1;
        }
    CHECK(found > 0);
    entire_result result = entire_model_from_bytes((const uint8_t *)bytes, size, model);
    free(bytes);
    return result;
}

static void hostile_files(const char *path) {
    entire_model *model = NULL;
    size_t size = 0;
    uint8_t *bytes = read_file(path, &size);
    for (size_t cut = 0; cut < size; cut += 97)
        EXPECT(ENTIRE_INVALID_MODEL, entire_model_from_bytes(cut ? bytes : NULL, cut, &model));
    OK(entire_model_from_bytes(bytes, size, &model));
    entire_model_free(model);
    model = NULL;

    EXPECT(ENTIRE_INVALID_TENSOR, altered(path, "prednet.1.weight", "prednet.1.xeight", &model));
    SAYS("prednet.1.weight");
    EXPECT(ENTIRE_INVALID_MODEL, altered(path, "log_seconds", "log_minutes", &model));
    EXPECT(ENTIRE_INVALID_MODEL, altered(path, "entire.format", "entire.farmot", &model));
    CHECK(model == NULL);
    free(bytes);

    EXPECT(ENTIRE_IO, entire_model_open("/no/such/file", &model));
    SAYS("/no/such/file");
    EXPECT(ENTIRE_IO, entire_model_open("/", &model));
    EXPECT(ENTIRE_IO, entire_model_open("", &model));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_open("\xc3\x28", &model));
    CHECK(model == NULL);

    /* A file without the networks that the call needs. */
    OK(altered(path, "\"prednet.", "\"predmet.", &model));
    entire_session *session = NULL;
    float seconds = 0;
    EXPECT(ENTIRE_UNSUPPORTED, entire_model_predict(model, &seconds, 1, &seconds));
    EXPECT(ENTIRE_UNSUPPORTED, entire_session_new(model, NULL, &session));
    CHECK(session == NULL && info_of(model).input_count == 0 && info_of(model).target == ENTIRE_TARGET_NONE);
    entire_model_free(model);

    OK(altered(path, "\"volumenet.", "\"volumemet.", &model));
    entire_volume *volume = toy_volume();
    size_t count = 0;
    EXPECT(ENTIRE_UNSUPPORTED, entire_model_encode(model, volume, &seconds, 1, &count));
    OK(entire_session_new(model, NULL, &session));
    EXPECT(ENTIRE_UNSUPPORTED, entire_session_set_volume(session, volume));
    entire_session_free(session);
    session = NULL;
    entire_volume_free(volume);
    entire_model_free(model);

    /* A model with an input group that a session cannot supply: entire_session_new() refuses it and names the group. */
    OK(altered(path, "\"camera", "\"camfra", &model));
    EXPECT(ENTIRE_MISSING_INPUT, entire_session_new(model, NULL, &session));
    SAYS("camfra");
    CHECK(session == NULL);
    entire_model_free(model);
}

/* The machine's model is in the user's data folder, where `entire calibrate` puts it. */
static void machines_model(const char *path) {
    entire_model *model = NULL;
    char folder[] = "/tmp/entire-test-XXXXXX", inner[64], file[96];
    CHECK(mkdtemp(folder) != NULL);
    CHECK(setenv("XDG_DATA_HOME", folder, 1) == 0);
    EXPECT(ENTIRE_IO, entire_model_open_machine(ENTIRE_SHADING_LOCAL, &model));
    SAYS("entire calibrate --shade local");
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_model_open_machine(9, &model));
    CHECK(model == NULL);
    snprintf(inner, sizeof inner, "%s/entire", folder);
    snprintf(file, sizeof file, "%s/machine-local.safetensors", inner);
    char whole[4096];
    CHECK(realpath(path, whole) != NULL);
    CHECK(mkdir(inner, 0700) == 0 && symlink(whole, file) == 0);
    OK(entire_model_open_machine(ENTIRE_SHADING_LOCAL, &model));
    CHECK(info_of(model).input_count == 11);
    entire_model_free(model);
    model = NULL;
    EXPECT(ENTIRE_IO, entire_model_open_machine(ENTIRE_SHADING_NONE, &model));
    CHECK(unlink(file) == 0 && rmdir(inner) == 0 && rmdir(folder) == 0);
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    entire_model *model = open_toy(argv[1]);
    descriptions(model);
    predictions(model);
    encodings(model);
    entire_model_free(model);
    entire_model_free(NULL);
    hostile_files(argv[1]);
    machines_model(argv[1]);
    return 0;
}
