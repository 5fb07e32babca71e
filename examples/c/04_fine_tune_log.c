/* Writes the parameters and times of frames to a timing table. From such a table, `entire train` trains or fine-tunes a
 * model for your renderer and device. The columns and their units are those of `entire collect`. A field that was not
 * measured stays empty; it is never 0.
 *
 *   04_fine_tune_log VOLUME.nrrd NX NY NZ LOG.csv
 */
#include <entire/advanced.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static const char columns[] = "frame,repeat,volume,member,time_step,dims_x,dims_y,dims_z,camera_rx_deg,camera_ry_deg,"
    "camera_dz_radii,fov_y_deg,width_px,height_px,step_ref,shading,skipping,termination,tf,seconds_device,"
    "seconds_wall,seconds_cpu,samples,skips,rays,shaded\n";
static const char *const shadings[] = {"", "none", "local", "scatter", "local-scatter"};
static const char *const skippings[] = {"", "none", "blocks", "distance"};

/* Returns the wall seconds of a frame. Replace this function by your renderer; here, the work is proportional to the
 * number of pixels divided by the step. */
static volatile float sink;
static double draw(const entire_frame *frame) {
    struct timespec a, b;
    timespec_get(&a, TIME_UTC);
    long work = (long)((float)frame->width * (float)frame->height * 20 / frame->step);
    for (long i = 0; i < work; ++i) sink = sink * 0.999f + 1;
    timespec_get(&b, TIME_UTC);
    return (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec);
}

int main(int argc, char **argv) {
    if (argc != 6) return fprintf(stderr, "usage: %s VOLUME NX NY NZ LOG.csv\n", argv[0]), 2;
    FILE *log = fopen(argv[5], "w");
    if (!log) return perror(argv[5]), 1;
    fputs(columns, log);

    entire_frame frame;
    if (entire_frame_init(&frame, sizeof frame) != ENTIRE_OK) return 1;
    const entire_gaussian_lobe lobe = {.center = 0.5f, .width = 0.02f, .height = 0.6f};
    enum { FRAMES = 24, REPEATS = 3 };
    for (int i = 0; i < FRAMES; ++i) {
        frame.width = frame.height = 32u << (i % 3);
        frame.arcball[0] = -60.0f + 120.0f * (float)i / FRAMES;
        frame.arcball[1] = 360.0f * (float)i / FRAMES;
        frame.arcball[2] = i % 2 ? 2.5f : 4.0f;
        frame.step = (float)(1 << (i % 4));
        for (int repeat = 0; repeat < REPEATS; ++repeat) { /* training uses the median of the repeats */
            double wall = draw(&frame);
            fprintf(log, "%d,%d,\"%s\",,,%s,%s,%s,%.9g,%.9g,%.9g,%.9g,%u,%u,%.9g,%s,%s,%.9g,%.9g %.9g %.9g,,%.9g,,,,,\n",
                    i, repeat, argv[1], argv[2], argv[3], argv[4], frame.arcball[0], frame.arcball[1], frame.arcball[2],
                    frame.fov_y, frame.width, frame.height, frame.step, shadings[frame.shading],
                    skippings[frame.skipping], frame.termination, lobe.center, lobe.width, lobe.height, wall);
        }
    }
    if (fclose(log) != 0) return perror(argv[5]), 1;
    printf("%d frames, %d repeats each, in %s\n", FRAMES, REPEATS, argv[5]);
    return 0;
}
