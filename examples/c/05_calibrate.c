/* An application that fits a model of its own renderer in its render loop: it records frames, fits a model to them,
 * steers by this model, and saves it for the next run. The renderer is a formula here.
 *
 *   05_calibrate OUT.safetensors
 */
#include <entire/advanced.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { N = 48, VOLUMES = 4, FRAMES = 60 };
static uint8_t voxels[N * N * N];

static void check(entire_result result) {
    if (result != ENTIRE_OK) {
        fprintf(stderr, "%s: %s\n", entire_result_name(result), entire_last_error());
        exit(1);
    }
}

/* Returns the seconds that a renderer would measure. */
static float draw(const entire_frame *frame, float step) {
    return 1e-3f + (float)(frame->width * frame->height) * (2e-8f + 1.5e-7f / (step * frame->arcball[2]));
}

/* Gives the session a volume with one ball, whose size depends on `which`, and a transfer function. */
static void show(entire_session *session, int which) {
    for (int i = 0; i < N * N * N; ++i) {
        const float x = (float)(i % N) - N / 2, y = (float)(i / N % N) - N / 2, z = (float)(i / N / N) - N / 2;
        voxels[i] = (uint8_t)fmaxf(0, fminf(255, 12 * ((float)(10 + 3 * which) - sqrtf(x * x + y * y + z * z))));
    }
    entire_volume_desc desc;
    check(entire_volume_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.voxels = voxels, desc.voxel_count = sizeof voxels;
    desc.dims[0] = desc.dims[1] = desc.dims[2] = N;
    entire_volume *volume = NULL;
    check(entire_volume_new(&desc, &volume));
    check(entire_session_set_volume(session, volume));
    entire_volume_free(volume);
    const entire_gaussian_lobe lobe = {.center = 0.5f, .width = 0.1f, .height = 0.02f};
    entire_transfer_function *tf = NULL;
    check(entire_transfer_function_from_lobes(&lobe, 1, &tf));
    check(entire_session_set_transfer_function(session, tf));
    entire_transfer_function_free(tf);
}

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: %s OUT.safetensors\n", argv[0]), 2;
    entire_session *session = NULL;
    check(entire_session_new(NULL, NULL, &session));
    check(entire_session_set_timing_source(session, "a formula", "wall"));
    check(entire_session_record(session, NULL, 1000));
    entire_frame frame;
    check(entire_frame_init(&frame, sizeof frame));
    for (int v = 0; v < VOLUMES; ++v) {
        show(session, v);
        for (int i = 0; i < FRAMES; ++i) { /* image sizes, directions and distances as users will choose them */
            frame.width = 64 + 97u * (unsigned)i % 500, frame.height = 64 + 61u * (unsigned)i % 400;
            frame.arcball[1] = 47.0f * (float)i;
            frame.arcball[2] = 1.5f + (float)(i % 5) / 2;
            entire_plan plan = {.struct_size = sizeof plan};
            check(entire_session_plan(session, &frame, 0.02f, &plan));
            check(entire_session_observe(session, plan.id, draw(&frame, plan.step), 0, NULL));
        }
    }
    entire_model *mine = NULL;
    entire_calibration_report report = {.struct_size = sizeof report};
    check(entire_session_calibrate(session, &mine, &report));
    printf("%zu frames, median error on held-out volumes %.1f %%\n", report.frames, 100 * report.median_error);
    check(entire_session_set_model(session, mine));
    check(entire_model_save(mine, argv[1]));

    entire_prediction expected = {.struct_size = sizeof expected};
    check(entire_session_predict(session, &frame, &expected));
    printf("the next frame: expected %.2f ms, takes %.2f ms\n", 1e3 * expected.seconds, 1e3 * draw(&frame, frame.step));
    entire_model_free(mine);
    return entire_session_free(session), 0;
}
