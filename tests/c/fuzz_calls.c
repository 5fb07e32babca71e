/* Calls random entry points with random valid and invalid arguments. Every call must return: never a panic code, never
 * a crash, and outputs stay unchanged when a call fails.
 *
 *   fuzz_calls MODEL SEQUENCES [SEED]
 *
 * Pointers are NULL or point to as many elements as the call states; all other arguments are arbitrary.
 */
#include "check.h"
#include <inttypes.h>
#include <math.h>

enum { SLOTS = 3, CALLS = 24 };

static uint64_t state = 1;

static uint64_t bits(void) {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

static size_t below(size_t n) {
    return (size_t)(bits() >> 11) % n;
}

static int one_in(size_t n) {
    return below(n) == 0;
}

static float uniform(float low, float high) {
    return low + (high - low) * (float)(bits() >> 40) / (float)(1 << 24);
}

/* Returns a number that mostly lies between `low` and `high`, but is sometimes any float. */
static float number(float low, float high) {
    static const float odd[] = {0, -1, 1e-30f, 1e30f, -1e30f, 3.4e38f, INFINITY, -INFINITY, NAN, -0.0f};
    if (one_in(12)) return odd[below(sizeof odd / sizeof odd[0])];
    if (one_in(40)) {
        const uint32_t raw = (uint32_t)bits();
        float any;
        memcpy(&any, &raw, sizeof any);
        return any;
    }
    return uniform(low, high);
}

static size_t count_near(size_t right) {
    static const size_t odd[] = {0, 1, SIZE_MAX, SIZE_MAX / 2, SIZE_MAX / 16, (size_t)1 << 40};
    return one_in(10) ? odd[below(6)] : right;
}

/* A number of any magnitude: 10^-38 to 10^38, sometimes negative. */
static float magnitude(void) {
    return powf(10, uniform(-38, 38)) * (one_in(20) ? -1.0f : 1.0f);
}

/* 0, 1, or a size of any magnitude. */
static size_t any_size(void) {
    const size_t any = (size_t)bits() >> below(sizeof(size_t) * 8);
    return one_in(3) ? below(2) : any;
}

/* Returns a count of elements that the library may read: at most `there`, the number of elements in the array. */
static size_t count_within(size_t there) {
    return one_in(6) ? below(there + 1) : there;
}

static uint32_t kind(uint32_t last) {
    return one_in(12) ? (uint32_t)bits() : 1 + (uint32_t)below(last);
}

static size_t struct_size(size_t right) {
    static const size_t odd[] = {0, 7, 8, 9, SIZE_MAX, 1 << 16};
    return one_in(25) ? odd[below(6)] : right;
}

static entire_model *models[SLOTS];
static entire_volume *volumes[SLOTS];
static entire_transfer_function *tfs[SLOTS];
static entire_session *sessions[SLOTS];
static uint64_t failures[128], successes;

/* Mostly the first slot, which holds the valid scene of most sequences; sometimes NULL. */
#define PICK(pool) (one_in(40) ? NULL : (pool)[one_in(6) ? below(SLOTS) : 0])

static entire_result note(entire_result result) {
    if (result == ENTIRE_PANIC || strcmp(entire_result_name(result), "unknown result") == 0) {
        fprintf(stderr, "a call gave %" PRIu32 ": %s\n", result, entire_last_error());
        exit(1);
    }
    CHECK((entire_last_error()[0] == '\0') == (result == ENTIRE_OK));
    if (result == ENTIRE_OK) successes += 1;
    else failures[result] += 1;
    return result;
}

static uint8_t voxels[4096];
static uint8_t *model_bytes;
static size_t model_size;

static void new_volume(entire_volume **out) {
    entire_volume_desc desc;
    OK(entire_volume_desc_init(&desc, sizeof desc));
    desc.struct_size = struct_size(sizeof desc);
    desc.scalar_type = kind(10);
    desc.ownership = kind(2);
    desc.voxels = one_in(30) ? NULL : voxels + (one_in(4) ? below(4) : 0);
    desc.voxel_count = count_within(500);
    for (int i = 0; i < 3; ++i) {
        desc.dims[i] = count_near(1 + below(8));
        desc.spacing[i] = number(0.1f, 9);
        if (one_in(8)) desc.strides[i] = count_near(below(20));
    }
    if (one_in(6)) { /* one scale for all axes, or a scale of its own for each */
        const float unit = magnitude();
        const int apart = one_in(3);
        for (int i = 0; i < 3; ++i) desc.spacing[i] = apart ? magnitude() : unit * uniform(0.5f, 2);
    }
    if (one_in(6))
        for (int i = 0; i < 3; ++i) desc.strides[i] = any_size();
    /* Strides of 0, which repeat one voxel: sizes of any magnitude, few of which are small enough to be scanned. */
    if (one_in(12))
        for (int i = 0; i < 3; ++i) {
            desc.strides[i] = 0;
            desc.dims[i] = one_in(20) ? 1 + below(200) : one_in(2) ? any_size() : 1 + below(20);
            if (desc.dims[i] < 4000 && desc.dims[i] > 200) desc.dims[i] = 200;
        }
    if (one_in(3)) desc.range[0] = number(-10, 10), desc.range[1] = number(-10, 1000);
    note(entire_volume_new(&desc, out));
}

static void new_bricks(entire_volume **out) {
    float bounds[64];
    for (int i = 0; i < 64; ++i) bounds[i] = number(0, 1);
    entire_brick_desc desc;
    OK(entire_brick_desc_init(&desc, sizeof desc));
    desc.struct_size = struct_size(sizeof desc);
    desc.scalar_type = kind(10);
    size_t bricks = 1;
    for (int i = 0; i < 3; ++i) {
        const size_t n = 1 + below(3), edge = 1 + below(9);
        desc.brick_edge[i] = count_near(edge);
        desc.dims[i] = count_near(n * edge - below(edge));
        desc.spacing[i] = one_in(6) ? magnitude() : number(0.1f, 9);
        bricks *= n;
    }
    if (one_in(12))
        for (int i = 0; i < 3; ++i) desc.dims[i] = any_size(), desc.brick_edge[i] = any_size();
    desc.bounds = one_in(30) ? NULL : bounds;
    desc.brick_count = one_in(10) ? below(33) : bricks;
    note(entire_volume_from_bricks(&desc, out));
}

static void new_transfer_function(entire_transfer_function **out) {
    switch (below(3)) {
    case 0: {
        entire_gaussian_lobe lobes[4];
        for (int i = 0; i < 4; ++i) lobes[i] = (entire_gaussian_lobe){number(0, 1), number(0.001f, 0.1f), number(0, 1)};
        note(entire_transfer_function_from_lobes(one_in(20) ? NULL : lobes, one_in(2) ? 1 : below(5), out));
        break;
    }
    case 1: {
        entire_opacity_node o[4];
        entire_color_node c[4];
        for (int i = 0; i < 4; ++i) {
            o[i] = (entire_opacity_node){(double)number(0, 1) + i, (double)number(0, 1), (double)number(0, 1), (double)number(0, 1)};
            c[i] = (entire_color_node){(double)number(0, 1) + i, {(double)number(0, 1), 0, 1}, (double)number(0, 1), (double)number(0, 1)};
        }
        note(entire_transfer_function_from_nodes(one_in(20) ? NULL : o, below(5), c, below(5), (double)number(-1, 1),
                                                 (double)number(1, 5), (uint32_t)below(3), out));
        break;
    }
    default: {
        float table[64];
        for (int i = 0; i < 64; ++i) table[i] = uniform(0, 1);
        if (one_in(4)) table[below(64)] = number(0, 1);
        note(entire_transfer_function_from_table(one_in(20) ? NULL : table, one_in(9) ? below(16) : 16, out));
    }
    }
}

static entire_frame any_frame(void) {
    entire_frame frame;
    OK(entire_frame_init(&frame, sizeof frame));
    frame.struct_size = struct_size(sizeof frame);
    frame.width = one_in(20) ? (uint32_t)bits() : 1 + (uint32_t)below(2048);
    frame.height = one_in(20) ? (uint32_t)bits() : 1 + (uint32_t)below(2048);
    frame.camera = one_in(4) ? kind(2) : ENTIRE_CAMERA_ARCBALL;
    frame.fov_y = number(1, 170);
    frame.arcball[0] = number(-720, 720);
    frame.arcball[1] = number(-720, 720);
    frame.arcball[2] = number(0.01f, 10);
    for (int i = 0; i < 16; ++i)
        if (one_in(30)) frame.view[i] = number(-1, 1);
    frame.view[14] = number(-20, 1);
    for (int i = 0; i < 3; ++i) frame.volume_center[i] = number(-5, 5);
    if (one_in(2)) frame.volume_radius = number(0.1f, 100);
    frame.step = number(0.02f, 100);
    frame.termination = number(0.01f, 1);
    frame.shading = kind(4);
    frame.skipping = kind(3);
    frame.jitter = (uint32_t)below(2);
    frame.projection = one_in(3) ? kind(2) : ENTIRE_PROJECTION_PERSPECTIVE;
    frame.parallel_scale = number(0.01f, 10);
    return frame;
}

static void call(void) {
    float f[64];
    for (int i = 0; i < 64; ++i) f[i] = number(-2, 300);
    size_t n = 12345;
    entire_model *model = PICK(models);
    entire_volume *volume = PICK(volumes);
    entire_transfer_function *tf = PICK(tfs);
    entire_session *session = PICK(sessions);
    entire_frame frame = any_frame();
    entire_plan plan = {.struct_size = struct_size(sizeof plan), .id = 777};
    const size_t slot = one_in(6) ? 0 : below(SLOTS);
    uint8_t bytes[8192];
    const size_t entry = one_in(3) ? 14 + below(3) : below(30);
    switch (entry) {
    case 0:
        entire_model_free(models[slot]);
        models[slot] = NULL;
        if (one_in(4)) { /* a damaged file, half of the time */
            uint8_t *copy = malloc(model_size);
            CHECK(copy != NULL);
            memcpy(copy, model_bytes, model_size);
            if (one_in(2)) copy[below(one_in(2) ? 1500 : model_size)] ^= (uint8_t)(1u << below(8));
            note(entire_model_from_bytes(copy, count_within(model_size), &models[slot]));
            free(copy);
        } else {
            note(entire_model_from_bytes(model_bytes, model_size, &models[slot]));
        }
        break;
    case 1:
        entire_volume_free(volumes[slot]);
        volumes[slot] = NULL;
        new_volume(&volumes[slot]);
        break;
    case 2:
        entire_volume_free(volumes[slot]);
        volumes[slot] = NULL;
        new_bricks(&volumes[slot]);
        break;
    case 3:
        entire_transfer_function_free(tfs[slot]);
        tfs[slot] = NULL;
        new_transfer_function(&tfs[slot]);
        break;
    case 4: {
        entire_session_options options;
        OK(entire_session_options_init(&options, sizeof options));
        options.struct_size = struct_size(sizeof options);
        options.finest_step = number(0.02f, 2);
        options.coarsest_step = number(2, 100);
        options.miss_rate = number(0.001f, 0.9f);
        options.tolerance = number(0, 1);
        options.trust_limit = number(0.1f, 5);
        options.damping = (uint32_t)below(2);
        options.probe_side = one_in(3) ? (uint32_t)below(26) : 0;
        options.probe_tolerance = one_in(3) ? number(0, 1.1f) : 0;
        entire_session_free(sessions[slot]);
        sessions[slot] = NULL;
        note(entire_session_new(one_in(2) ? NULL : model, one_in(2) ? NULL : &options, &sessions[slot]));
        break;
    }
    case 5: {
        entire_model_info info = {.struct_size = struct_size(sizeof info)};
        note(entire_model_describe(model, &info));
        break;
    }
    case 6: {
        entire_input_group group = {.struct_size = struct_size(sizeof group)};
        note(entire_model_input_group(model, count_near(below(6)), &group));
        break;
    }
    case 7:
        (void)entire_model_scene_feature(model, below(3));
        (void)entire_model_metadata(model, one_in(9) ? NULL : one_in(5) ? "\xfe" : "entire.device");
        break;
    case 8:
        if (one_in(4) && note(entire_model_encode(model, volume, one_in(20) ? NULL : f, count_within(64), &n)) != ENTIRE_OK)
            CHECK(n == 12345);
        break;
    case 9: {
        float seconds = 0.5f;
        if (note(entire_model_predict(model, one_in(20) ? NULL : f, one_in(5) ? below(64) : 11, &seconds)) != ENTIRE_OK)
            CHECK(seconds == 0.5f);
        break;
    }
    case 10: {
        float seconds[5] = {0.5f, 0.5f, 0.5f, 0.5f, 0.5f};
        if (note(entire_model_predict_batch(model, f, one_in(9) ? 0 : 5, one_in(9) ? below(12) : 11, seconds)) != ENTIRE_OK)
            CHECK(seconds[0] == 0.5f && seconds[4] == 0.5f);
        break;
    }
    case 11:
        note(entire_volume_set_features(volume, one_in(20) ? NULL : f, below(4)));
        break;
    case 12: {
        entire_volume_info info = {.struct_size = struct_size(sizeof info)};
        if (note(entire_volume_describe(volume, &info)) == ENTIRE_OK)
            CHECK(!(info.non_finite_share < 0 || info.non_finite_share > 1));
        break;
    }
    case 13:
        note(entire_transfer_function_set_unit_distance(tf, number(0.01f, 50), kind(2)));
        break;
    case 14: /* the calls that a render loop makes come most often */
        if (note(entire_session_plan(session, &frame, number(1e-4f, 0.1f), &plan)) != ENTIRE_OK) CHECK(plan.id == 777);
        else if (one_in(2)) note(entire_session_observe(session, plan.id, number(1e-4f, 0.2f), kind(4) - 1, NULL));
        break;
    case 15:
        note(one_in(3) ? entire_session_set_time_step(session, volume) : entire_session_set_volume(session, volume));
        break;
    case 16:
        note(entire_session_set_transfer_function(session, tf));
        break;
    case 17: {
        entire_prediction prediction = {.struct_size = struct_size(sizeof prediction), .seconds = 0.5f};
        if (note(entire_session_predict(session, &frame, &prediction)) != ENTIRE_OK) CHECK(prediction.seconds == 0.5f);
        else CHECK(prediction.seconds > 0 && prediction.seconds < 1e9f);
        break;
    }
    case 18: {
        entire_setting settings[ENTIRE_MAX_SETTINGS + 1];
        for (int i = 0; i <= ENTIRE_MAX_SETTINGS; ++i)
            settings[i] = (entire_setting){uniform(0.1f, 20), 1 + (uint32_t)below(999), 1 + (uint32_t)below(999),
                                           1 + (uint32_t)below(3), 1 + (uint32_t)below(3)};
        if (one_in(5)) settings[0] = (entire_setting){number(0.1f, 20), (uint32_t)below(9), (uint32_t)bits(), kind(4), kind(3)};
        const size_t count = one_in(9) ? below(ENTIRE_MAX_SETTINGS + 2) : 4;
        if (note(entire_session_choose(session, &frame, settings, count, number(1e-4f, 0.1f), &n, &plan)) != ENTIRE_OK)
            CHECK(n == 12345 && plan.id == 777);
        else CHECK(n < count);
        break;
    }
    case 19:
        note(entire_session_observe(session, one_in(2) ? bits() : below(200), number(1e-4f, 1), (uint32_t)below(5), NULL));
        break;
    case 20:
        note(entire_session_set_limits(session, number(0.02f, 4), number(4, 100)));
        note(entire_session_set_max_image_sample_distance(session, number(0.5f, 70), number(0.5f, 5)));
        if (one_in(2)) note(entire_session_set_quality(session, number(0, 4), number(0.1f, 3), number(0.1f, 3), number(0, 1)));
        break;
    case 21:
        note(entire_session_set_enabled(session, (uint32_t)below(3)));
        note(entire_session_set_processor_seconds(session, number(-0.01f, 0.2f)));
        break;
    case 22:
        note(entire_session_mark(session, (uint32_t)below(70)));
        break;
    case 23:
        note(one_in(2) ? entire_session_withdraw(session, below(100)) : entire_session_reset(session));
        break;
    case 24: {
        size_t size = 0;
        if (note(entire_session_save_state(session, bytes, sizeof bytes, &size)) == ENTIRE_OK) {
            if (one_in(2) && size > 0) bytes[below(size)] ^= (uint8_t)(1u << below(8));
            note(entire_session_load_state(PICK(sessions), bytes, count_within(size)));
        }
        break;
    }
    case 25:
        note(entire_transfer_function_table(tf, f, count_within(64)));
        break;
    case 26:
        note(entire_frame_init(&frame, struct_size(sizeof frame) == sizeof frame ? sizeof frame : 3));
        break;
    case 27: {
        note(entire_session_record(session, one_in(2) ? model : NULL, one_in(3) ? bits() : 8 + below(40)));
        note(entire_session_recorded_count(session, &n));
        for (int i = 0; i < 6; i++)
            note(entire_session_record_picture(session, below(4), 1 + (float)(i % 3), 1 + (float)(i / 3) * 0.4f, number(0, 1), number(0, 9)));
        float q[4];
        note(entire_session_quality(session, q, q + 1, one_in(5) ? NULL : q + 2, q + 3));
        break;
    }
    case 28: {
        entire_model *made = NULL;
        entire_calibration_report report = {.struct_size = struct_size(sizeof report)};
        if (note(entire_session_calibrate(session, &made, one_in(2) ? NULL : &report)) == ENTIRE_OK) {
            note(entire_session_set_model(PICK(sessions), made));
            entire_model_free(made);
        }
        note(entire_session_set_model(session, model));
        break;
    }
    default:
        (void)entire_result_name((uint32_t)bits());
        entire_model_free(models[slot]);
        models[slot] = NULL;
    }
}

int main(int argc, char **argv) {
    CHECK(argc >= 3);
    model_bytes = read_file(argv[1], &model_size);
    const long sequences = strtol(argv[2], NULL, 10);
    const uint64_t seed = argc > 3 ? strtoull(argv[3], NULL, 10) : 1;
    for (size_t i = 0; i < sizeof voxels; ++i) voxels[i] = (uint8_t)(i * 37);
    for (long i = 0; i < sequences; ++i) {
        state = (seed + 1) * 0x9e3779b97f4a7c15u + (uint64_t)i * 0xbf58476d1ce4e5b9u + 1;
        for (int k = 0; k < 4; ++k) bits();
        /* Most sequences start from a valid scene, so that most of the library is reached. */
        if (!one_in(8)) {
            OK(entire_model_from_bytes(model_bytes, model_size, &models[0]));
            volumes[0] = toy_volume();
            tfs[0] = toy_transfer_function();
            sessions[0] = toy_session(one_in(2) ? NULL : models[0]);
        }
        for (int k = 0; k < CALLS; ++k) call();
        for (int k = 0; k < SLOTS; ++k) {
            entire_session_free(sessions[k]);
            entire_model_free(models[k]);
            entire_volume_free(volumes[k]);
            entire_transfer_function_free(tfs[k]);
            sessions[k] = NULL, models[k] = NULL, volumes[k] = NULL, tfs[k] = NULL;
        }
    }
    free(model_bytes);
    printf("%ld sequences, seed %" PRIu64 ": %" PRIu64 " calls succeeded;", sequences, seed, successes);
    for (uint32_t code = 0; code < 128; ++code)
        if (failures[code]) printf(" %" PRIu64 " x %s", failures[code], entire_result_name(code));
    printf("; no panic\n");
    return 0;
}
