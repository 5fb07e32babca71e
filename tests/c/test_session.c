/* entire_session: plan, observe, choose, state, and what is refused; without a model and with one. */
#include "check.h"
#include <math.h>

static entire_plan plan_of(entire_session *session, const entire_frame *frame, float target) {
    entire_plan plan = {.struct_size = sizeof plan};
    OK(entire_session_plan(session, frame, target, &plan));
    CHECK(plan.id != 0 && plan.step >= 1.0f / 64 && plan.step <= 4096);
    CHECK(((plan.absent & ENTIRE_ABSENT_SECONDS) != 0) == (isnan(plan.seconds) != 0));
    CHECK(((plan.absent & ENTIRE_ABSENT_UPPER) != 0) == (isnan(plan.upper) != 0));
    CHECK(((plan.absent & ENTIRE_ABSENT_OUT_OF_RANGE) != 0) == (isnan(plan.out_of_range) != 0));
    CHECK(plan.reason >= ENTIRE_REASON_FITS && plan.reason <= ENTIRE_REASON_OFF);
    return plan;
}

/* Lets the session learn from 12 frames; returns a plan whose target is half of the time at the finest step. */
static entire_plan plan_for_half(entire_session *session, const entire_frame *frame) {
    entire_frame large = *frame;
    large.width = large.height = 1024;
    float seconds = 0;
    for (int i = 0; i < 12; ++i) {
        const entire_plan finest = plan_of(session, &large, 1e4f);
        seconds = finest.seconds;
        OK(entire_session_observe(session, finest.id, seconds, 0, NULL));
    }
    return plan_of(session, &large, 0.5f * seconds);
}

/* Seconds of a renderer with a fixed cost and a cost per sample. */
static float draw(float step) {
    return 0.003f + 0.1f / step;
}

static void loop(const entire_model *model) {
    entire_session *session = toy_session(model);
    entire_frame frame = toy_frame();
    int within = 0;
    for (int i = 0; i < 80; ++i) {
        frame.arcball[1] = (float)(i % 30);
        entire_plan plan = plan_of(session, &frame, 0.03f);
        const float seconds = draw(plan.step);
        entire_verdict verdict = 99;
        OK(entire_session_observe(session, plan.id, seconds, 0, &verdict));
        CHECK(verdict <= ENTIRE_VERDICT_IGNORED);
        within += i >= 40 && seconds < 0.03f * 1.1f && seconds > 0.03f * 0.5f;
    }
    CHECK(within >= 36);
    entire_session_free(session);
}

/* A renderer that takes 40 times as long as an untrained model predicts, and half as long again from frame 50 on: the step
 * adapts to the load, or does not change if the load is ignored. */
static void loads(void) {
    entire_session *truth = toy_session(NULL);
    for (uint32_t ignored = 0; ignored < 2; ++ignored) {
        entire_session_options options;
        OK(entire_session_options_init(&options, sizeof options));
        CHECK(options.ignore_load == 0);
        options.ignore_load = ignored;
        entire_session *session = toy_session_with(NULL, &options);
        entire_frame frame = toy_frame();
        entire_prediction drawn = {.struct_size = sizeof drawn};
        OK(entire_session_predict(truth, &frame, &drawn));
        const float target = 50 * drawn.seconds;
        float before = 0;
        for (int i = 0; i < 60; ++i) {
            const entire_plan plan = plan_of(session, &frame, target);
            if (i == 49) before = plan.step;
            frame.step = plan.step;
            OK(entire_session_predict(truth, &frame, &drawn));
            OK(entire_session_observe(session, plan.id, (i < 50 ? 40 : 60) * drawn.seconds, 0, NULL));
        }
        CHECK(before == 1 && (ignored ? frame.step == 1 : frame.step > 1.3f));
        entire_session_free(session);
    }
    entire_session_free(truth);
}

/* A slow frame with little processor time begins a load: the next plan is coarser than without this time. */
static void processor_time(void) {
    entire_session *truth = toy_session(NULL);
    float steps[2] = {0, 0};
    for (int reported = 0; reported < 2; ++reported) {
        entire_session *session = toy_session(NULL);
        entire_frame frame = toy_frame();
        entire_prediction drawn = {.struct_size = sizeof drawn};
        OK(entire_session_predict(truth, &frame, &drawn));
        const float target = 50 * drawn.seconds;
        for (int i = 0; i < 52; ++i) {
            frame.step = 1;
            const entire_plan plan = plan_of(session, &frame, target);
            steps[reported] = frame.step = plan.step;
            OK(entire_session_predict(truth, &frame, &drawn));
            const float usual = 40 * drawn.seconds;
            if (reported) {
                OK(entire_session_set_processor_seconds(session, 1.9f * usual));
            }
            OK(entire_session_observe(session, plan.id, i < 50 ? usual : 2 * usual, 0, NULL));
        }
        entire_session_free(session);
    }
    CHECK(steps[1] > 1.3f * steps[0]);
    entire_session_free(truth);
}

static void observations(void) {
    entire_session *session = toy_session(NULL);
    entire_frame frame = toy_frame();
    entire_plan plan = plan_of(session, &frame, 0.03f);
    const float bad[] = {0, -1, NAN, INFINITY, 20000};
    entire_verdict verdict = 77;
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; ++i)
        EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, plan.id, bad[i], 0, &verdict));
    EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, 0, 0.01f, 0, &verdict));
    EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, plan.id + 1, 0.01f, 0, &verdict));
    SAYS("plans came after it");
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_observe(session, plan.id, 0.01f, 4, &verdict));
    SAYS("flags");
    CHECK(verdict == 77);
    OK(entire_session_observe(session, plan.id, 0.01f, ENTIRE_OBSERVE_UNUSUAL, &verdict));
    CHECK(verdict != 77);
    EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, plan.id, 0.01f, 0, NULL));
    SAYS("observed before");
    plan = plan_of(session, &frame, 0.03f);
    OK(entire_session_observe(session, plan.id, 1e-6f, ENTIRE_OBSERVE_CANCELLED, NULL));

    /* Late observations are accepted for the last 64 plans; older plans are forgotten. */
    uint64_t ids[80];
    for (int i = 0; i < 80; ++i) ids[i] = plan_of(session, &frame, 0.03f).id;
    EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, ids[15], 0.01f, 0, NULL));
    OK(entire_session_observe(session, ids[16], 0.01f, 0, NULL));
    OK(entire_session_observe(session, ids[79], 0.01f, 0, NULL));

    /* A withdrawn plan is forgotten, and the next one has its id. */
    plan = plan_of(session, &frame, 0.03f);
    OK(entire_session_withdraw(session, plan.id));
    EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, plan.id, 0.01f, 0, NULL));
    CHECK(plan_of(session, &frame, 0.03f).id == plan.id);
    OK(entire_session_withdraw(session, ids[79]));
    OK(entire_session_observe(session, plan.id, 0.01f, 0, NULL));
    OK(entire_session_reset(session));
    EXPECT(ENTIRE_REJECTED_OBSERVATION, entire_session_observe(session, ids[78], 0.01f, 0, NULL));
    entire_session_free(session);
}

static void order_of_calls(void) {
    entire_session *session = NULL;
    entire_frame frame = toy_frame();
    entire_plan plan = {.struct_size = sizeof plan, .id = 5};
    entire_prediction prediction = {.struct_size = sizeof prediction};
    OK(entire_session_new(NULL, NULL, &session));
    EXPECT(ENTIRE_NOT_READY, entire_session_plan(session, &frame, 0.03f, &plan));
    SAYS("no volume is set");
    EXPECT(ENTIRE_NOT_READY, entire_session_predict(session, &frame, &prediction));
    frame.camera = ENTIRE_CAMERA_VIEW;
    EXPECT(ENTIRE_NOT_READY, entire_session_plan(session, &frame, 0.03f, &plan));
    SAYS("volume_radius");
    frame = toy_frame();
    entire_volume *volume = toy_volume();
    OK(entire_session_set_volume(session, volume));
    EXPECT(ENTIRE_NOT_READY, entire_session_plan(session, &frame, 0.03f, &plan));
    SAYS("no transfer function is set");
    CHECK(plan.id == 5 && isnan(prediction.seconds) == 0);
    entire_volume_free(volume);
    entire_session_free(session);
    entire_session_free(NULL);
}

static void frames(void) {
    entire_session *session = toy_session(NULL);
    entire_plan plan = {.struct_size = sizeof plan};
#define REFUSE(change, words)                                                                          \
    do {                                                                                               \
        entire_frame frame = toy_frame();                                                              \
        change;                                                                                        \
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_plan(session, &frame, 0.03f, &plan));       \
        SAYS(words);                                                                                   \
        CHECK(plan.id == 0);                                                                           \
    } while (0)
    REFUSE(frame.width = 0, "image size");
    REFUSE(frame.height = 16385, "image size");
    REFUSE(frame.camera = 3, "camera is 3");
    REFUSE(frame.fov_y = 180, "field of view");
    REFUSE(frame.fov_y = NAN, "field of view");
    REFUSE(frame.projection = 3, "projection is 3");
    REFUSE(frame.projection = ENTIRE_PROJECTION_PARALLEL, "parallel scale is NaN");
    REFUSE((frame.projection = ENTIRE_PROJECTION_PARALLEL, frame.parallel_scale = 0), "parallel scale is 0");
    REFUSE(frame.arcball[0] = NAN, "angles");
    REFUSE(frame.arcball[2] = 0, "distance");
    REFUSE(frame.step = 0, "step");
    REFUSE(frame.step = NAN, "step");
    REFUSE(frame.termination = 0, "termination");
    REFUSE(frame.shading = 0, "shading is 0");
    REFUSE(frame.shading = 5, "shading is 5");
    REFUSE(frame.skipping = 9, "skipping is 9");
    REFUSE((frame.camera = ENTIRE_CAMERA_VIEW, frame.view[0] = 2), "view matrix");
    REFUSE((frame.camera = ENTIRE_CAMERA_VIEW, frame.view[5] = NAN), "NaN");
    REFUSE((frame.camera = ENTIRE_CAMERA_VIEW, frame.volume_radius = -1), "radius");
    const float targets[] = {0, -1, NAN, INFINITY};
    entire_frame frame = toy_frame();
    for (size_t i = 0; i < 4; ++i)
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_plan(session, &frame, targets[i], &plan));
    frame.struct_size = 12;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_plan(session, &frame, 0.03f, &plan));
    frame = toy_frame();
    plan.struct_size = 0;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_plan(session, &frame, 0.03f, &plan));

    /* An arcball and a matrix with the same eye give the same prediction. The volume's box is 5 x 14 x 77, centered at
     * (1, 2, 3). */
    entire_prediction a = {.struct_size = sizeof a}, b = a;
    frame.arcball[2] = 2;
    OK(entire_session_predict(session, &frame, &a));
    frame.camera = ENTIRE_CAMERA_VIEW;
    frame.volume_center[0] = 1, frame.volume_center[1] = 2, frame.volume_center[2] = 3;
    const float radius = 0.5f * sqrtf(25 + 14 * 14 + 77 * 77);
    frame.view[12] = -1, frame.view[13] = -2, frame.view[14] = -3 - 2 * radius;
    OK(entire_session_predict(session, &frame, &b));
    CHECK(fabsf(a.seconds - b.seconds) < 1e-4f * a.seconds);
    frame.volume_radius = 2 * radius;
    frame.view[14] = -3 - 4 * radius;
    OK(entire_session_predict(session, &frame, &b));
    CHECK(fabsf(a.seconds - b.seconds) < 0.01f * a.seconds);

    /* With a parallel projection, an arcball (scale in radii) and a matrix (scale in world units) give the same
     * prediction, at any distance of the eye from the volume. */
    frame = toy_frame();
    frame.projection = ENTIRE_PROJECTION_PARALLEL;
    frame.parallel_scale = 0.8f;
    OK(entire_session_predict(session, &frame, &a));
    frame.camera = ENTIRE_CAMERA_VIEW;
    frame.parallel_scale = 0.8f * radius;
    frame.volume_center[0] = 1, frame.volume_center[1] = 2, frame.volume_center[2] = 3;
    for (float distance = 2; distance < 1000; distance *= 7) {
        frame.view[12] = -1, frame.view[13] = -2, frame.view[14] = -3 - distance * radius;
        OK(entire_session_predict(session, &frame, &b));
        CHECK(fabsf(a.seconds - b.seconds) < 1e-3f * a.seconds);
    }
    frame.parallel_scale = 0.4f * radius;
    OK(entire_session_predict(session, &frame, &b));
    CHECK(b.seconds > a.seconds);
    a.struct_size = 3;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_predict(session, &frame, &a));
    entire_session_free(session);
}

static void options(const entire_model *model) {
    entire_session_options good;
    OK(entire_session_options_init(&good, sizeof good));
    CHECK(good.finest_step == 1 && good.coarsest_step == 16 && good.damping == 1);
    entire_session *session = NULL;
#define REFUSE_OPTIONS(change)                                                                         \
    do {                                                                                               \
        entire_session_options o = good;                                                             \
        change;                                                                                        \
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_new(model, &o, &session));                  \
        CHECK(session == NULL);                                                                      \
    } while (0)
    REFUSE_OPTIONS(o.finest_step = 0);
    REFUSE_OPTIONS(o.finest_step = NAN);
    REFUSE_OPTIONS(o.coarsest_step = 0.5f);
    REFUSE_OPTIONS(o.miss_rate = 0);
    REFUSE_OPTIONS(o.miss_rate = 1);
    REFUSE_OPTIONS(o.tolerance = -1);
    REFUSE_OPTIONS(o.tolerance = INFINITY);
    REFUSE_OPTIONS(o.trust_limit = NAN);
    REFUSE_OPTIONS(o.probe_side = 25);
    SAYS("1 to 24");
    REFUSE_OPTIONS(o.probe_tolerance = 1.5f);
    REFUSE_OPTIONS(o.probe_tolerance = -0.1f);
    REFUSE_OPTIONS(o.probe_tolerance = NAN);
    REFUSE_OPTIONS(o.reserved = 1);
    SAYS("reserved");
    entire_session_options sized = good;
    sized.struct_size = 1;
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_new(model, &sized, &session));
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_options_init(&sized, 1));

    good.finest_step = 2;
    good.coarsest_step = 3;
    OK(entire_session_new(model, &good, &session));
    entire_session_free(session);

    session = toy_session(NULL);
    entire_frame frame = toy_frame();
    OK(entire_session_set_limits(session, 5, 6));
    for (int i = 0; i < 5; ++i) {
        const float step = plan_of(session, &frame, i % 2 ? 1e-6f : 10.0f).step;
        CHECK(step >= 5 && step <= 6);
    }
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_limits(session, 6, 5));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_limits(session, NAN, 5));

    OK(entire_session_set_limits(session, 1, 8));
    CHECK(plan_of(session, &frame, 1e-6f).image_sample_distance == 1);
    OK(entire_session_set_max_image_sample_distance(session, 4, 1));
    const entire_plan smallest = plan_of(session, &frame, 1e-6f);
    CHECK(smallest.image_sample_distance > 3 && smallest.image_sample_distance <= 4 && smallest.step > 7.99f && smallest.step < 8.01f);
    CHECK(plan_of(session, &frame, 10.0f).image_sample_distance == 1);
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_max_image_sample_distance(session, 0.5f, 1));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_max_image_sample_distance(session, 2, NAN));
    /* With a quality law in which smaller images add more error than coarser steps, the step is coarsened; with the
     * opposite law, the image becomes smaller. */
    OK(entire_session_set_limits(session, 1, 100));
    OK(entire_session_set_quality(session, 500, 1, 0.1f, 0));
    const entire_plan coarse = plan_for_half(session, &frame);
    OK(entire_session_set_quality(session, 0.002f, 1, 1, 0));
    const entire_plan small = plan_for_half(session, &frame);
    CHECK(coarse.step > 10 && small.step < 1.5f && small.image_sample_distance > 1.1f);
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_quality(session, -1, 1, 1, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_quality(session, 1, NAN, 1, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_quality(session, 1, 1, 9, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_quality(session, 1, 1, 1, 1));
    OK(entire_session_set_quality(session, 0, 1, 1, 0));
    OK(entire_session_set_max_image_sample_distance(session, 1, 1));
    OK(entire_session_set_limits(session, 5, 6));

    frame.step = 7.5f;
    OK(entire_session_set_enabled(session, 0));
    entire_plan plan = plan_of(session, &frame, 0.03f);
    CHECK(plan.step == 7.5f && plan.reason == ENTIRE_REASON_OFF);
    OK(entire_session_set_enabled(session, 1));
    CHECK(plan_of(session, &frame, 0.03f).step <= 6);

    OK(entire_session_mark(session, 63));
    OK(entire_session_mark(session, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_mark(session, 64));
    entire_session_free(session);
}

/* Without a model, `probe_side` is the number of probe rays per side: 0 means 11; fewer rays predict similar times. */
static void probe_sides(void) {
    entire_session_options options;
    OK(entire_session_options_init(&options, sizeof options));
    CHECK(options.probe_side == 0 && options.probe_tolerance == 0);
    entire_frame frame = toy_frame();
    float seconds[4];
    for (int i = 0; i < 4; ++i) {
        const uint32_t sides[] = {0, 11, 7, 4};
        options.probe_side = sides[i];
        entire_session *session = toy_session_with(NULL, &options);
        entire_prediction prediction = {.struct_size = sizeof prediction};
        OK(entire_session_predict(session, &frame, &prediction));
        seconds[i] = prediction.seconds;
        entire_session_free(session);
    }
    CHECK(seconds[0] > 0 && seconds[0] == seconds[1]);
    CHECK(seconds[2] != seconds[0] && fabsf(seconds[2] / seconds[0] - 1) < 0.3f);
    CHECK(seconds[3] != seconds[2] && fabsf(seconds[3] / seconds[0] - 1) < 0.5f);
    /* With `probe_tolerance`, a plan whose step does not depend on the probe uses the coarsest probe; a prediction uses
     * the finest probe. */
    options.probe_side = 0;
    options.probe_tolerance = 0.05f;
    entire_session *climbs = toy_session_with(NULL, &options);
    options.probe_side = 4;
    options.probe_tolerance = 0;
    entire_session *coarse = toy_session_with(NULL, &options);
    CHECK(plan_of(climbs, &frame, 1e4f).seconds == plan_of(coarse, &frame, 1e4f).seconds);
    entire_prediction finest = {.struct_size = sizeof finest};
    OK(entire_session_reset(climbs));
    OK(entire_session_predict(climbs, &frame, &finest));
    CHECK(finest.seconds == seconds[0]);
    entire_session_free(coarse);
    entire_session_free(climbs);
}

static void choices(void) {
    entire_session *session = toy_session(NULL);
    entire_frame frame = toy_frame();
    const entire_setting settings[] = {
        {1, 1024, 512, ENTIRE_SHADING_LOCAL, ENTIRE_SKIPPING_BLOCKS},
        {2, 512, 256, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS},
        {8, 64, 32, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_DISTANCE},
    };
    size_t index = 99;
    entire_plan plan = {.struct_size = sizeof plan};
    OK(entire_session_choose(session, &frame, settings, 3, 1000, &index, &plan));
    CHECK(index == 0 && plan.step == 1);
    OK(entire_session_choose(session, &frame, settings, 3, 1e-9f, &index, &plan));
    CHECK(index == 2 && plan.step == 8 && plan.reason == ENTIRE_REASON_TARGET_UNREACHABLE);
    OK(entire_session_observe(session, plan.id, 0.01f, 0, NULL));

    index = 99;
    plan.id = 0;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_choose(session, &frame, NULL, 0, 0.03f, &index, &plan));
    EXPECT(ENTIRE_NULL_ARGUMENT, entire_session_choose(session, &frame, NULL, 1, 0.03f, &index, &plan));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_session_choose(session, &frame, settings, ENTIRE_MAX_SETTINGS + 1, 0.03f, &index, &plan));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_choose(session, &frame, settings, 3, NAN, &index, &plan));
    entire_setting bad = settings[0];
    bad.step = NAN;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_choose(session, &frame, &bad, 1, 0.03f, &index, &plan));
    bad = settings[0];
    bad.shading = 17;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_choose(session, &frame, &bad, 1, 0.03f, &index, &plan));
    CHECK(index == 99 && plan.id == 0);
    entire_session_free(session);
}

/* Seconds of a renderer whose time depends only on the number of pixels. */
static float draw_pixels(uint32_t width, uint32_t height) {
    return 1e-3f + 4e-8f * (float)(width * height);
}

static void play(entire_session *session, int frames) {
    entire_frame frame = toy_frame();
    for (int i = 0; i < frames; ++i) {
        frame.arcball[1] = (float)(i * 7 % 90);
        frame.width = (uint32_t)(64 + i * 37 % 400);
        frame.height = (uint32_t)(64 + i * 53 % 300);
        entire_plan plan = plan_of(session, &frame, 0.5f);
        OK(entire_session_observe(session, plan.id, draw_pixels(frame.width, frame.height), 0, NULL));
    }
}

/* Records pictures of four scenes; their errors and times are computed from a quality law. */
static void compare_pictures(entire_session *session) {
    const float steps[] = {1, 1.5f, 2.2f, 3.2f, 4.5f}, distances[] = {1, 1.2f, 1.44f, 2};
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_record_picture(session, 0, 0.5f, 1, 0.1, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_record_picture(session, 0, 1, NAN, 0.1, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_record_picture(session, 0, 1, 1, 0, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_record_picture(session, 0, 1, 1, 0.1, -1));
    for (uint64_t scene = 0; scene < 4; scene++)
        for (int i = 0; i < 5; i++)
            for (int k = 0; k < 4; k++) {
                double s = steps[i], d = distances[k];
                double seconds = 0.1 * (0.2 + 0.8 / s) / (d * d);
                double error = pow(s - 1, 1.2) + 5 * pow(d - 1, 0.9);
                OK(entire_session_record_picture(session, scene, steps[i], distances[k], seconds, error));
            }
}

static void calibration(void) {
    entire_session *session = toy_session(NULL);
    size_t count = 77;
    OK(entire_session_recorded_count(session, &count));
    CHECK(count == 0);
    entire_model *model = NULL;
    EXPECT(ENTIRE_NOT_READY, entire_session_calibrate(session, &model, NULL));
    SAYS("call record");
    EXPECT(ENTIRE_NOT_READY, entire_session_record_picture(session, 0, 1, 1, 0.1, 0));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_record(session, NULL, 7));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_record(session, NULL, 65537));
    OK(entire_session_record(session, NULL, 100));
    play(session, 5);
    EXPECT(ENTIRE_NOT_READY, entire_session_calibrate(session, &model, NULL));
    entire_calibration_report small = {.struct_size = 3};
    EXPECT(ENTIRE_STRUCT_SIZE, entire_session_calibrate(session, &model, &small));
    CHECK(model == NULL);
    play(session, 150);
    OK(entire_session_recorded_count(session, &count));
    CHECK(count == 100);

    OK(entire_session_set_timing_source(session, "a renderer of pixels", "wall"));
    entire_calibration_report without = {.struct_size = sizeof without};
    OK(entire_session_calibrate(session, &model, &without));
    CHECK(without.scenes == 0 && entire_model_metadata(model, "entire.quality") == NULL);
    entire_model_free(model);
    compare_pictures(session);
    entire_calibration_report report = {.struct_size = sizeof report};
    OK(entire_session_calibrate(session, &model, &report));
    CHECK(report.frames == 100 && report.held_out == ENTIRE_HELD_OUT_STRETCHES);
    CHECK(report.median_error < 0.05 && report.rmse_over_sd < 0.1 && report.upper_factor < 1.3);
    CHECK(report.scenes == 4);
    CHECK(strcmp(entire_model_metadata(model, "entire.clock"), "wall") == 0);
    CHECK(strcmp(entire_model_metadata(model, "entire.renderer"), "a renderer of pixels") == 0);

    /* The model predicts frames that it was not fitted to, in this session and, read from its file, in another. */
    float known[4] = {9, 9, 9, 9};
    OK(entire_session_quality(session, known, known + 1, known + 2, known + 3));
    CHECK(known[0] == 0 && known[1] == 0 && known[2] == 0 && known[3] == 0);
    OK(entire_session_set_model(session, model));
    /* The session takes the quality law of a model of its own renderer, until the host sets another law. */
    OK(entire_session_quality(session, known, known + 1, known + 2, known + 3));
    CHECK(fabsf(known[0] - 5) < 0.1f && fabsf(known[1] - 1.2f) < 0.02f && fabsf(known[2] - 0.9f) < 0.02f && fabsf(known[3] - 0.2f) < 0.01f);
    OK(entire_session_set_quality(session, 3, 1, 1, 0));
    OK(entire_session_quality(session, known, known + 1, known + 2, known + 3));
    CHECK(known[0] == 3 && known[3] == 0);
    OK(entire_session_set_quality(session, 0, 1, 1, 0));
    OK(entire_session_set_timing_source(session, "another renderer", "wall"));
    OK(entire_session_quality(session, known, known + 1, known + 2, known + 3));
    CHECK(known[0] == 0);
    OK(entire_session_set_timing_source(session, "a renderer of pixels", "wall"));
    const char *path = "calibrated.safetensors";
    EXPECT(ENTIRE_IO, entire_model_save(model, "no/such/folder/calibrated.safetensors"));
    OK(entire_model_save(model, path));
    entire_model *again = NULL;
    OK(entire_model_open(path, &again));
    CHECK(remove(path) == 0);
    entire_session *other = toy_session(again);
    entire_frame frame = toy_frame();
    frame.width = 333;
    frame.height = 222;
    entire_prediction p = {.struct_size = sizeof p}, q = p;
    OK(entire_session_predict(session, &frame, &p));
    OK(entire_session_predict(other, &frame, &q));
    const float real = draw_pixels(frame.width, frame.height);
    CHECK(p.seconds == q.seconds && fabsf(p.seconds / real - 1) < 0.1f);

    /* The fitted model can be the prior of another calibration, and works with any probe, since it consists of unit
     * costs. */
    OK(entire_session_record(other, again, 8));
    play(other, 20);
    entire_model *third = NULL;
    OK(entire_session_calibrate(other, &third, NULL));
    entire_session_options options;
    OK(entire_session_options_init(&options, sizeof options));
    options.probe_side = 5;
    entire_session *coarse = NULL;
    OK(entire_session_new(NULL, &options, &coarse));
    OK(entire_session_record(coarse, again, 100));
    OK(entire_session_record(coarse, NULL, 100));
    OK(entire_session_set_model(coarse, again));
    entire_session_free(coarse);
    entire_session_free(other);
    entire_session_free(session);
    entire_model_free(third);
    entire_model_free(again);
    entire_model_free(model);
}

static void state(void) {
    entire_session *a = toy_session(NULL), *b = toy_session(NULL);
    entire_frame frame = toy_frame();
    for (int i = 0; i < 30; ++i) {
        entire_plan plan = plan_of(a, &frame, 0.03f);
        OK(entire_session_observe(a, plan.id, draw(plan.step), 0, NULL));
    }
    size_t size = 0, again = 0;
    OK(entire_session_save_state(a, NULL, 0, &size));
    CHECK(size > 0);
    uint8_t *bytes = malloc(size);
    CHECK(bytes != NULL);
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_session_save_state(a, bytes, size - 1, &again));
    CHECK(again == 0);
    OK(entire_session_save_state(a, bytes, size, &again));
    CHECK(again == size);

    for (size_t cut = 0; cut < size; ++cut)
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_load_state(b, cut ? bytes : NULL, cut));
    OK(entire_session_load_state(b, bytes, size));
    entire_prediction p = {.struct_size = sizeof p}, q = p;
    OK(entire_session_predict(a, &frame, &p));
    OK(entire_session_predict(b, &frame, &q));
    CHECK(p.source != 0 && isfinite(p.seconds));
    OK(entire_session_reset(b));

    /* A state belongs to one renderer and one clock; a refused state changes nothing. */
    OK(entire_session_set_timing_source(a, "a mapper", "wall"));
    OK(entire_session_save_state(a, NULL, 0, &again));
    uint8_t *named = malloc(again);
    CHECK(named != NULL);
    OK(entire_session_save_state(a, named, again, &size));
    static const char *const sources[][2] = {{"", ""}, {"a mapper", ""}, {"a mapper", "cpu"}, {"another", "wall"}};
    OK(entire_session_predict(b, &frame, &p));
    for (size_t i = 0; i < sizeof sources / sizeof sources[0]; ++i) {
        OK(entire_session_set_timing_source(b, sources[i][0], sources[i][1]));
        EXPECT(ENTIRE_UNSUPPORTED, entire_session_load_state(b, named, size));
        CHECK(strstr(entire_last_error(), i == 2 || i == 1 ? "clock" : "renderer") != NULL);
        OK(entire_session_predict(b, &frame, &q));
        CHECK(p.seconds == q.seconds);
    }
    OK(entire_session_set_timing_source(b, "a mapper", "wall"));
    entire_clock of_model = ENTIRE_CLOCK_CPU, own = ENTIRE_CLOCK_CPU;
    OK(entire_session_clocks(b, &of_model, &own));
    CHECK(of_model == ENTIRE_CLOCK_UNSTATED && own == ENTIRE_CLOCK_WALL);
    OK(entire_session_load_state(b, named, size));
    OK(entire_session_predict(b, &frame, &q));
    CHECK(p.seconds != q.seconds);
    char long_name[258];
    memset(long_name, 'x', 257);
    long_name[257] = '\0';
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_timing_source(b, long_name, "wall"));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_session_set_timing_source(b, "\xff", "wall"));
    OK(entire_session_load_state(b, named, size));
    free(named);
    free(bytes);
    entire_session_free(a);
    entire_session_free(b);
}

static void with_a_model(const char *path) {
    entire_model *model = NULL;
    OK(entire_model_open(path, &model));
    options(model);
    loop(model);

    /* The session keeps its own reference to the model. */
    entire_session *session = toy_session(model);
    entire_frame frame = toy_frame();
    entire_prediction prediction = {.struct_size = sizeof prediction};
    entire_volume *volume = toy_volume();
    float features[2];
    size_t count = 0;
    OK(entire_model_encode(model, volume, features, 2, &count));

    /* The source of the first prediction is the network. Precomputed volume features give the same prediction. */
    OK(entire_session_predict(session, &frame, &prediction));
    CHECK(prediction.source == ENTIRE_SOURCE_NETWORK && isfinite(prediction.seconds) && prediction.seconds > 0);
    OK(entire_volume_set_features(volume, features, 2));
    OK(entire_session_set_volume(session, volume));
    entire_transfer_function *tf = toy_transfer_function();
    OK(entire_session_set_transfer_function(session, tf));
    entire_prediction again = {.struct_size = sizeof again};
    OK(entire_session_predict(session, &frame, &again));
    CHECK(again.seconds == prediction.seconds);

    /* A session with this model keeps the probe of its training: `probe_side` has no effect. */
    entire_session_options small;
    OK(entire_session_options_init(&small, sizeof small));
    small.probe_side = 4;
    entire_session *other = NULL;
    OK(entire_session_new(model, &small, &other));
    OK(entire_session_set_volume(other, volume));
    OK(entire_session_set_transfer_function(other, tf));
    OK(entire_session_predict(other, &frame, &again));
    CHECK(again.seconds == prediction.seconds);
    entire_session_free(other);

    const float three[] = {1, 2, 3};
    OK(entire_volume_set_features(volume, three, 3));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_session_set_volume(session, volume));
    SAYS("3 precomputed features");

    entire_model_free(model);
    OK(entire_session_predict(session, &frame, &again));
    CHECK(again.seconds == prediction.seconds);

    /* A transfer function that is not made of lobes has no values for this model's transfer_function group. */
    const float table[8] = {0, 0, 0, 0, 1, 1, 1, 0.5f};
    entire_transfer_function_free(tf);
    OK(entire_transfer_function_from_table(table, 2, &tf));
    OK(entire_session_set_transfer_function(session, tf));
    EXPECT(ENTIRE_MISSING_INPUT, entire_session_predict(session, &frame, &again));
    SAYS("lobes");
    entire_transfer_function_free(tf);

    /* Bricks without voxels cannot be encoded. */
    const float bounds[2] = {0, 1};
    entire_brick_desc desc;
    OK(entire_brick_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U8;
    for (int i = 0; i < 3; ++i) desc.dims[i] = desc.brick_edge[i] = 8;
    desc.bounds = bounds;
    desc.brick_count = 1;
    entire_volume *boxes = NULL;
    OK(entire_volume_from_bricks(&desc, &boxes));
    EXPECT(ENTIRE_NOT_READY, entire_session_set_volume(session, boxes));
    OK(entire_volume_set_features(boxes, features, 2));
    OK(entire_session_set_volume(session, boxes));
    entire_volume_free(boxes);
    entire_volume_free(volume);
    entire_session_free(session);
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    loop(NULL);
    loads();
    processor_time();
    observations();
    order_of_calls();
    frames();
    options(NULL);
    probe_sides();
    choices();
    state();
    calibration();
    with_a_model(argv[1]);
    return 0;
}
