/* A steered render loop: plans each frame, draws the frame with the plan's step, and observes the time that the frame
 * took. No model file is needed: the session starts from a cost model and learns the speed of the renderer (here a
 * formula) from the first frames. At frame 20, the transfer function changes abruptly.
 *
 *   03_plan_observe
 */
#include <entire/entire.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

enum { N = 48, FRAMES = 40 };
static uint8_t voxels[N * N * N];

static void check(entire_result result) {
    if (result != ENTIRE_OK) {
        fprintf(stderr, "%s: %s\n", entire_result_name(result), entire_last_error());
        exit(1);
    }
}

/* Returns the seconds that a renderer would measure. A thin medium takes longer, since rays go further in it. */
static float draw(float step, int dense) {
    return 0.004f + (dense ? 0.05f : 0.2f) / step;
}

/* Sets an opacity that has a peak of the given height in the middle of the voxels' range, 128 to 255. */
static void set_peak(entire_session *session, double height) {
    const entire_opacity_node opacity[] = {{185, 0, 0.5, 0}, {192, height, 0.5, 0}, {199, 0, 0.5, 0}};
    entire_transfer_function *tf = NULL;
    check(entire_transfer_function_from_nodes(opacity, 3, NULL, 0, 128, 255, 1, &tf));
    check(entire_session_set_transfer_function(session, tf));
    entire_transfer_function_free(tf); /* the session has a copy of the data that it needs */
}

int main(void) {
    for (int i = 0; i < N * N * N; ++i) voxels[i] = (uint8_t)(128 + 127 * ((i / N) % N) / N);
    entire_volume_desc desc;
    check(entire_volume_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.voxels = voxels;
    desc.voxel_count = sizeof voxels;
    desc.dims[0] = desc.dims[1] = desc.dims[2] = N;
    desc.range[0] = 128, desc.range[1] = 255; /* that of the transfer function; by default 0 to 255 for U8 voxels */
    entire_volume *volume = NULL;
    check(entire_volume_new(&desc, &volume));

    entire_session *session = NULL;
    check(entire_session_new(NULL, NULL, &session));
    check(entire_session_set_volume(session, volume));
    set_peak(session, 0.9);

    entire_frame frame;
    check(entire_frame_init(&frame, sizeof frame));
    frame.width = frame.height = 512;
    for (int i = 0; i < FRAMES; ++i) {
        int dense = i < FRAMES / 2;
        if (i == FRAMES / 2) set_peak(session, 0.01);
        frame.arcball[1] = 3.0f * (float)i;
        entire_plan plan = {.struct_size = sizeof plan};
        check(entire_session_plan(session, &frame, 0.04f, &plan));
        float seconds = draw(plan.step, dense);
        check(entire_session_observe(session, plan.id, seconds, 0, NULL));
        printf("frame %2d  step %5.2f  predicted ", i, plan.step);
        if (plan.absent & ENTIRE_ABSENT_SECONDS) printf("   unknown");
        else printf("%7.1f ms", 1e3 * plan.seconds);
        printf("  took %6.1f ms  reason %u\n", 1e3 * seconds, plan.reason);
    }
    entire_session_free(session);
    entire_volume_free(volume);
    return 0;
}
