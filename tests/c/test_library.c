/* Version, result names, last error, struct sizes, frame budgets. */
#include "check.h"
#include <math.h>

_Static_assert(ENTIRE_OK == 0 && ENTIRE_INVALID_ARGUMENT == 1 && ENTIRE_SIZE_MISMATCH == 2 && ENTIRE_INVALID_MODEL == 3 &&
                   ENTIRE_INVALID_TENSOR == 4 && ENTIRE_MISSING_INPUT == 5 && ENTIRE_NOT_READY == 6 &&
                   ENTIRE_REJECTED_OBSERVATION == 7 && ENTIRE_UNSUPPORTED == 8 && ENTIRE_NULL_ARGUMENT == 100 &&
                   ENTIRE_STRUCT_SIZE == 101 && ENTIRE_IO == 102 && ENTIRE_PANIC == 103 && ENTIRE_OUT_OF_MEMORY == 104,
               "result numbers never change");
_Static_assert(ENTIRE_STRIDE_CONTIGUOUS == SIZE_MAX, "the library compares strides with SIZE_MAX");

/* The sizes and field offsets of the structs of ABI version 1 on 64-bit targets. */
_Static_assert(sizeof(void *) != 8 || sizeof(entire_model_info) == 56, "entire_model_info");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_input_group) == 32, "entire_input_group");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_volume_desc) == 104, "entire_volume_desc");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_brick_desc) == 88, "entire_brick_desc");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_volume_info) == 80, "entire_volume_info");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_frame) == 144, "entire_frame");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_session_options) == 48, "entire_session_options");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_plan) == 48, "entire_plan");
_Static_assert(sizeof(void *) != 8 || sizeof(entire_prediction) == 32, "entire_prediction");
_Static_assert(sizeof(entire_gaussian_lobe) == 12 && sizeof(entire_opacity_node) == 32 &&
                   sizeof(entire_color_node) == 48 && sizeof(entire_setting) == 20,
               "elements of arrays");
_Static_assert(offsetof(entire_frame, view) == 36 && offsetof(entire_frame, volume_radius) == 112 &&
                   offsetof(entire_frame, shading) == 124,
               "entire_frame's fields");
_Static_assert(sizeof(void *) != 8 || (offsetof(entire_plan, id) == 8 && offsetof(entire_plan, step) == 16 &&
                                       offsetof(entire_plan, image_sample_distance) == 20 &&
                                       offsetof(entire_plan, seconds) == 24 && offsetof(entire_plan, absent) == 36 &&
                                       offsetof(entire_plan, reason) == 40),
               "entire_plan's fields");
_Static_assert(sizeof(void *) != 8 ||
                   (offsetof(entire_volume_desc, voxels) == 8 && offsetof(entire_volume_desc, scalar_type) == 24 &&
                    offsetof(entire_volume_desc, dims) == 32 && offsetof(entire_volume_desc, strides) == 56 &&
                    offsetof(entire_volume_desc, spacing) == 80 && offsetof(entire_volume_desc, range) == 92),
               "entire_volume_desc's fields");

/* Calls of a program that was compiled with another version of a struct, so that `struct_size` differs. */
static void struct_sizes(void) {
    struct {
        entire_frame frame;
        uint64_t later_field;
    } newer;
    memset(&newer, 0xff, sizeof newer);
    OK(entire_frame_init(&newer.frame, sizeof newer));
    CHECK(newer.frame.struct_size == sizeof newer && newer.later_field == 0);

    entire_session *session = toy_session(NULL);
    entire_plan plan = {.struct_size = sizeof plan};
    newer.frame.width = newer.frame.height = 32;
    OK(entire_session_plan(session, &newer.frame, 0.02f, &plan));
    newer.later_field = 1;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_plan(session, &newer.frame, 0.02f, &plan));
    SAYS("entire_frame.struct_size");

    const size_t bad[] = {0, 1, sizeof(size_t), sizeof(entire_frame) - 1, (size_t)1 << 16, SIZE_MAX};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; ++i) {
        entire_frame frame = toy_frame();
        EXPECT(ENTIRE_STRUCT_SIZE, entire_frame_init(&frame, bad[i]));
        frame.struct_size = bad[i];
        EXPECT(ENTIRE_STRUCT_SIZE, entire_session_plan(session, &frame, 0.02f, &plan));
    }
    /* An output struct of a newer caller is filled up to the fields that the library knows. */
    struct {
        entire_plan plan;
        uint64_t later_field;
    } newer_plan = {.plan = {.struct_size = sizeof newer_plan}, .later_field = 77};
    entire_frame frame = toy_frame();
    OK(entire_session_plan(session, &frame, 0.02f, &newer_plan.plan));
    CHECK(newer_plan.plan.struct_size == sizeof newer_plan && newer_plan.plan.id != 0 && newer_plan.later_field == 77);
    entire_session_free(session);
}

/* Checks the shares of two volumes that take 5 and 15 ms in a window whose other work takes 5 ms, and that invalid
 * times are refused. */
static void budget(void) {
    entire_budget budget = {{0}};
    entire_pass small = {{0}}, large = {{0}};
    float share = 0;
    for (int frame = 0; frame < 6; ++frame) {
        OK(entire_budget_begin(&budget, 2));
        OK(entire_budget_drew(&budget, &small, 0.005f, 0.010f));
        OK(entire_budget_drew(&budget, &large, 0.015f, 0.030f));
        OK(entire_budget_end(&budget, 0.025f, 1));
    }
    OK(entire_budget_begin(&budget, 2));
    OK(entire_budget_share(&budget, &small, 0.025f, &share));
    CHECK(share > 0.00499f && share < 0.00501f);
    OK(entire_budget_share(&budget, &large, 0.025f, &share));
    CHECK(share > 0.01499f && share < 0.01501f);
    const float odd[] = {-1, INFINITY, NAN};
    const entire_budget before = budget;
    for (int i = 0; i < 3; ++i) {
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_budget_share(&budget, &small, odd[i], &share));
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_budget_drew(&budget, &small, odd[i], 1));
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_budget_drew(&budget, &small, 1, odd[i]));
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_budget_end(&budget, odd[i], 1));
    }
    CHECK(memcmp(&before, &budget, sizeof budget) == 0 && share > 0.01499f);
}

int main(void) {
    CHECK(strcmp(entire_version(), ENTIRE_VERSION) == 0);
    CHECK(entire_version_number() == ENTIRE_VERSION_NUMBER);
    CHECK(entire_abi_version() == ENTIRE_ABI_VERSION);
    CHECK(ENTIRE_VERSION_NUMBER == ENTIRE_VERSION_MAJOR * 1000000 + ENTIRE_VERSION_MINOR * 1000 + ENTIRE_VERSION_PATCH);
    CHECK(strlen(entire_simd_level()) > 0);
    CHECK(strcmp(entire_result_name(ENTIRE_IO), "ENTIRE_IO") == 0);
    CHECK(strcmp(entire_result_name(12345), "unknown result") == 0);
    CHECK(entire_last_error()[0] == '\0');
    struct_sizes();
    budget();
    return 0;
}
