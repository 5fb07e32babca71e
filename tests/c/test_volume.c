/* entire_volume: every scalar type, copied and borrowed, strides, ranges, bricks, features, and what is refused. */
#include "check.h"
#include <math.h>

static entire_volume_desc desc_of(entire_scalar_type type, const void *voxels) {
    entire_volume_desc desc;
    OK(entire_volume_desc_init(&desc, sizeof desc));
    desc.scalar_type = type;
    desc.voxels = voxels;
    desc.voxel_count = TOY_VOXELS;
    desc.dims[0] = TOY_X;
    desc.dims[1] = TOY_Y;
    desc.dims[2] = TOY_Z;
    return desc;
}

static entire_volume_info info_of(const entire_volume *volume) {
    entire_volume_info info = {.struct_size = sizeof info};
    OK(entire_volume_describe(volume, &info));
    return info;
}

static void encoded(const entire_model *model, const entire_volume_desc *desc, float features[2]) {
    entire_volume *volume = NULL;
    size_t count = 0;
    OK(entire_volume_new(desc, &volume));
    OK(entire_model_encode(model, volume, features, 2, &count));
    CHECK(count == 2);
    entire_volume_free(volume);
}

/* Returns true if two feature vectors are equal up to rounding. */
static int close_to(const float a[2], const float b[2]) {
    return fabsf(a[0] - b[0]) < 1e-5f && fabsf(a[1] - b[1]) < 1e-5f;
}

/* The same values in every scalar type give the same features, and the same bits whether copied or borrowed. */
#define SAME_FEATURES(type, number, borrowable)                                                        \
    do {                                                                                               \
        type voxels[TOY_VOXELS];                                                                       \
        for (int i = 0; i < TOY_VOXELS; ++i) voxels[i] = (type)(i * 37 % 100);                         \
        entire_volume_desc desc = desc_of(number, voxels);                                             \
        desc.range[0] = 0;                                                                             \
        desc.range[1] = 100;                                                                           \
        float found[2];                                                                                \
        encoded(model, &desc, found);                                                                  \
        if (first) memcpy(wanted, found, sizeof found);                                                \
        first = 0;                                                                                     \
        CHECK(close_to(wanted, found));                                                                \
        memcpy(wanted, found, sizeof found);                                                           \
        desc.ownership = ENTIRE_VOXELS_BORROW;                                                         \
        if (borrowable) {                                                                              \
            encoded(model, &desc, found);                                                              \
            CHECK(memcmp(wanted, found, sizeof found) == 0);                                           \
        } else {                                                                                       \
            EXPECT(ENTIRE_UNSUPPORTED, entire_volume_new(&desc, &none));                               \
            SAYS("ENTIRE_VOXELS_COPY");                                                                \
        }                                                                                              \
    } while (0)

static void scalar_types(const entire_model *model) {
    float wanted[2] = {0, 0};
    int first = 1;
    entire_volume *none = NULL;
    SAME_FEATURES(uint8_t, ENTIRE_SCALAR_U8, 1);
    SAME_FEATURES(int8_t, ENTIRE_SCALAR_I8, 0);
    SAME_FEATURES(uint16_t, ENTIRE_SCALAR_U16, 1);
    SAME_FEATURES(int16_t, ENTIRE_SCALAR_I16, 1);
    SAME_FEATURES(uint32_t, ENTIRE_SCALAR_U32, 0);
    SAME_FEATURES(int32_t, ENTIRE_SCALAR_I32, 0);
    SAME_FEATURES(float, ENTIRE_SCALAR_F32, 1);
    SAME_FEATURES(double, ENTIRE_SCALAR_F64, 0);
    SAME_FEATURES(uint64_t, ENTIRE_SCALAR_U64, 0);
    SAME_FEATURES(int64_t, ENTIRE_SCALAR_I64, 0);
    CHECK(none == NULL);
}

static void layouts(const entire_model *model) {
    /* The toy volume inside a larger array, x slowest, by strides. */
    uint8_t plain[TOY_VOXELS], swapped[TOY_X * TOY_Y * TOY_Z + 3];
    for (int z = 0; z < TOY_Z; ++z)
        for (int y = 0; y < TOY_Y; ++y)
            for (int x = 0; x < TOY_X; ++x)
                plain[(z * TOY_Y + y) * TOY_X + x] = swapped[3 + (x * TOY_Y + y) * TOY_Z + z] = (uint8_t)(z * 20 + y * 5 + x);
    float wanted[2], found[2];
    entire_volume_desc desc = desc_of(ENTIRE_SCALAR_U8, plain);
    encoded(model, &desc, wanted);
    desc.voxels = swapped + 3;
    desc.strides[0] = TOY_Y * TOY_Z;
    desc.strides[1] = TOY_Z;
    desc.strides[2] = 1;
    encoded(model, &desc, found);
    CHECK(memcmp(wanted, found, sizeof found) == 0);
    desc.strides[2] = ENTIRE_STRIDE_CONTIGUOUS;
    entire_volume *none = NULL;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_volume_new(&desc, &none));
    SAYS("all three or none");

    /* Voxels that are not aligned can be copied, not borrowed. */
    char buffer[TOY_VOXELS * sizeof(uint16_t) + 1];
    for (int i = 0; i < TOY_VOXELS; ++i) {
        const uint16_t value = plain[i];
        memcpy(buffer + 1 + 2 * i, &value, sizeof value);
    }
    desc = desc_of(ENTIRE_SCALAR_U16, buffer + 1);
    desc.range[0] = 0;
    desc.range[1] = 255;
    encoded(model, &desc, found);
    CHECK(close_to(wanted, found));
    desc.ownership = ENTIRE_VOXELS_BORROW;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_volume_new(&desc, &none));
    SAYS("aligned");
    CHECK(none == NULL);
}

static void descriptions(void) {
    float voxels[TOY_VOXELS];
    for (int i = 0; i < TOY_VOXELS; ++i) voxels[i] = (float)i - 100;
    voxels[3] = NAN;
    voxels[4] = INFINITY;
    entire_volume_desc desc = desc_of(ENTIRE_SCALAR_F32, voxels);
    desc.spacing[0] = 2;
    desc.spacing[1] = 0.5f;
    desc.spacing[2] = 7;
    entire_volume *volume = NULL;
    OK(entire_volume_new(&desc, &volume));
    entire_volume_info info = info_of(volume);
    CHECK(info.dims[0] == TOY_X && info.dims[1] == TOY_Y && info.dims[2] == TOY_Z && info.has_voxels);
    CHECK(info.range[0] == -100 && info.range[1] == (float)(TOY_VOXELS - 101) && info.reference_step == 0.5f);
    CHECK(fabsf(info.bounding_radius - 0.5f * sqrtf(100 + 12.25f + 77 * 77)) < 1e-4f);
    CHECK(info.feature_count == 0 && info.scalar_type == ENTIRE_SCALAR_F32);
    CHECK(isnan(info.non_finite_share));

    const float features[] = {1, -2, 3};
    OK(entire_volume_set_features(volume, features, 3));
    CHECK(info_of(volume).feature_count == 3);
    const float bad[] = {1, NAN};
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_volume_set_features(volume, bad, 2));
    SAYS("feature 1");
    CHECK(info_of(volume).feature_count == 3);
    OK(entire_volume_set_features(volume, NULL, 0));
    CHECK(info_of(volume).feature_count == 0);
    info.struct_size = 5;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_volume_describe(volume, &info));
    entire_volume_free(volume);
    entire_volume_free(NULL);
}

static void refusals(void) {
    uint8_t voxels[TOY_VOXELS] = {0};
    entire_volume *none = NULL;
#define REFUSE(code, change, words)                                                                    \
    do {                                                                                               \
        entire_volume_desc desc = desc_of(ENTIRE_SCALAR_U8, voxels);                                   \
        change;                                                                                        \
        EXPECT(code, entire_volume_new(&desc, &none));                                                 \
        SAYS(words);                                                                                   \
        CHECK(none == NULL);                                                                           \
    } while (0)
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.scalar_type = 0, "scalar_type is 0");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.scalar_type = 11, "scalar_type is 11");
    REFUSE(ENTIRE_INVALID_ARGUMENT, (desc.scalar_type = 11, desc.ownership = ENTIRE_VOXELS_BORROW), "scalar_type is 11");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.ownership = 0, "ownership is 0");
    REFUSE(ENTIRE_NULL_ARGUMENT, desc.voxels = NULL, "voxels");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.dims[1] = 0, "along y");
    REFUSE(ENTIRE_SIZE_MISMATCH, desc.dims[2] += 1, "needs");
    REFUSE(ENTIRE_SIZE_MISMATCH, desc.voxel_count -= 1, "needs");
    REFUSE(ENTIRE_SIZE_MISMATCH, desc.voxel_count = SIZE_MAX, "memory");
    REFUSE(ENTIRE_SIZE_MISMATCH, (desc.voxel_count = SIZE_MAX, desc.ownership = ENTIRE_VOXELS_BORROW), "memory");
    REFUSE(ENTIRE_SIZE_MISMATCH, desc.dims[0] = desc.dims[1] = desc.dims[2] = SIZE_MAX, "at most");
    REFUSE(ENTIRE_SIZE_MISMATCH, desc.strides[0] = desc.strides[1] = desc.strides[2] = SIZE_MAX / 2, "too large");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.reserved = 1, "reserved");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.spacing[0] = 0, "spacing");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.spacing[1] = NAN, "spacing");
    REFUSE(ENTIRE_INVALID_ARGUMENT, desc.range[0] = 1, "range");
    REFUSE(ENTIRE_INVALID_ARGUMENT, (desc.range[0] = 2, desc.range[1] = 1), "range");
    REFUSE(ENTIRE_STRUCT_SIZE, desc.struct_size = 8, "entire_volume_desc");
}

static void bricks(void) {
    float bounds[2 * 2 * 3][2];
    for (int i = 0; i < 12; ++i) bounds[i][0] = 0.05f * (float)i, bounds[i][1] = 0.1f + 0.05f * (float)i;
    entire_brick_desc good;
    OK(entire_brick_desc_init(&good, sizeof good));
    good.scalar_type = ENTIRE_SCALAR_F64;
    good.dims[0] = 16;
    good.dims[1] = 9;
    good.dims[2] = 24;
    good.brick_edge[0] = good.brick_edge[1] = good.brick_edge[2] = 8;
    good.bounds = &bounds[0][0];
    good.brick_count = 12;
    good.spacing[2] = 3;
    entire_volume *volume = NULL;
    OK(entire_volume_from_bricks(&good, &volume));
    entire_volume_info info = info_of(volume);
    CHECK(info.dims[1] == 9 && !info.has_voxels && isnan(info.range[0]) && info.scalar_type == ENTIRE_SCALAR_F64);
    CHECK(info.reference_step == 1 && fabsf(info.bounding_radius - 0.5f * sqrtf(256 + 81 + 72 * 72)) < 1e-4f);

    entire_session *session = session_of(NULL, NULL, volume);
    entire_frame frame = toy_frame();
    entire_plan plan = {.struct_size = sizeof plan};
    OK(entire_session_plan(session, &frame, 0.01f, &plan));
    CHECK(plan.id != 0 && plan.step >= 1 && plan.step <= 16);
    entire_volume_desc none;
    OK(entire_volume_desc_init(&none, sizeof none));
    none.voxels = bounds;
    EXPECT(ENTIRE_NOT_READY, entire_volume_update(volume, &none));
    entire_session_free(session);
    entire_volume_free(volume);
    volume = NULL;

#define REFUSE_BRICKS(code, change)                                                                    \
    do {                                                                                               \
        entire_brick_desc desc = good;                                                                 \
        change;                                                                                        \
        EXPECT(code, entire_volume_from_bricks(&desc, &volume));                                       \
        CHECK(volume == NULL);                                                                         \
    } while (0)
    REFUSE_BRICKS(ENTIRE_SIZE_MISMATCH, desc.brick_count = 11);
    REFUSE_BRICKS(ENTIRE_NULL_ARGUMENT, desc.bounds = NULL);
    REFUSE_BRICKS(ENTIRE_INVALID_ARGUMENT, desc.dims[0] = 0);
    REFUSE_BRICKS(ENTIRE_INVALID_ARGUMENT, desc.brick_edge[2] = 0);
    REFUSE_BRICKS(ENTIRE_INVALID_ARGUMENT, desc.spacing[0] = -1);
    REFUSE_BRICKS(ENTIRE_INVALID_ARGUMENT, desc.scalar_type = 77);
    REFUSE_BRICKS(ENTIRE_SIZE_MISMATCH, desc.dims[0] = desc.dims[1] = desc.dims[2] = SIZE_MAX);
    REFUSE_BRICKS(ENTIRE_SIZE_MISMATCH, desc.brick_count = SIZE_MAX);
    REFUSE_BRICKS(ENTIRE_STRUCT_SIZE, desc.struct_size = 1);
    CHECK(entire_brick_desc_init(&good, 9) == ENTIRE_STRUCT_SIZE);
    entire_volume_desc desc;
    CHECK(entire_volume_desc_init(&desc, 9) == ENTIRE_STRUCT_SIZE);
}

/* A session that gets every time step of a volume predicts the same as a session that gets only the last time step. */
static void time_steps(entire_voxels_ownership ownership) {
    uint16_t voxels[TOY_VOXELS];
    for (int i = 0; i < TOY_VOXELS; ++i) voxels[i] = (uint16_t)(i % 3);
    entire_volume_desc desc = desc_of(ENTIRE_SCALAR_U16, voxels);
    desc.ownership = ownership;
    desc.range[1] = 100;
    desc.range[0] = 0;
    entire_volume *volume = NULL, *alone = NULL;
    OK(entire_volume_new(&desc, &volume));
    entire_session *follows = NULL, *given = NULL;
    entire_transfer_function *tf = toy_transfer_function();
    OK(entire_session_new(NULL, NULL, &follows));
    EXPECT(ENTIRE_NOT_READY, entire_session_set_time_step(follows, volume));
    OK(entire_session_set_volume(follows, volume));
    OK(entire_session_set_transfer_function(follows, tf));
    entire_frame frame = toy_frame();
    desc.range[1] = 101;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_volume_update(volume, &desc));
    for (int step = 0; step < 6; ++step) {
        const size_t first[3] = {0, 0, (size_t)step}, size[3] = {TOY_X, TOY_Y, 1};
        const size_t plane = (size_t)TOY_X * TOY_Y;
        for (size_t i = 0; i < plane; ++i) voxels[plane * (size_t)step + i] = (uint16_t)(40 + i % 30);
        const float ready[] = {1, 2};
        OK(entire_volume_set_features(volume, ready, 2));
        desc.range[0] = desc.range[1] = step % 3 ? NAN : 0;
        if (step % 3 == 0) desc.range[1] = 100;
        if (step % 2) OK(entire_volume_update_box(volume, &desc, first, size));
        else OK(entire_volume_update(volume, &desc));
        CHECK(info_of(volume).feature_count == 0 && info_of(volume).range[1] == 100);
        OK(entire_session_set_time_step(follows, volume));

        desc.range[0] = 0, desc.range[1] = 100;
        OK(entire_volume_new(&desc, &alone));
        given = session_of(NULL, NULL, alone);
        entire_prediction found = {.struct_size = sizeof found}, wanted = {.struct_size = sizeof wanted};
        OK(entire_session_predict(follows, &frame, &found));
        OK(entire_session_predict(given, &frame, &wanted));
        CHECK(found.seconds == wanted.seconds);
        entire_session_free(given);
        entire_volume_free(alone);
        alone = NULL;
    }
    const size_t origin[3] = {0, 0, 0}, beyond[3] = {1, TOY_Y + 1, 1}, far[3] = {SIZE_MAX, 0, 0};
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_volume_update_box(volume, &desc, origin, beyond));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_volume_update_box(volume, &desc, far, beyond));
#define REFUSE_STEP(code, change)                                                                      \
    do {                                                                                               \
        entire_volume_desc other = desc;                                                               \
        change;                                                                                        \
        EXPECT(code, entire_volume_update(volume, &other));                                            \
    } while (0)
    REFUSE_STEP(ENTIRE_INVALID_ARGUMENT, other.scalar_type = ENTIRE_SCALAR_I16);
    REFUSE_STEP(ENTIRE_INVALID_ARGUMENT, other.spacing[1] = 2);
    REFUSE_STEP(ENTIRE_INVALID_ARGUMENT, other.range[1] = 101);
    REFUSE_STEP(ENTIRE_SIZE_MISMATCH, other.dims[2] -= 1);
    REFUSE_STEP(ENTIRE_NULL_ARGUMENT, other.voxels = NULL);
    OK(entire_session_set_time_step(follows, volume));
    entire_session_free(follows);
    entire_transfer_function_free(tf);
    entire_volume_free(volume);
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    entire_model *model = NULL;
    OK(entire_model_open(argv[1], &model));
    scalar_types(model);
    layouts(model);
    entire_model_free(model);
    descriptions();
    refusals();
    bricks();
    time_steps(ENTIRE_VOXELS_COPY);
    time_steps(ENTIRE_VOXELS_BORROW);
    return 0;
}
