/* entire_transfer_function: lobes, nodes, tables, unit distances, and what is refused. */
#include "check.h"
#include <math.h>

enum { ENTRIES = ENTIRE_TABLE_ENTRIES };
static float rgba[ENTRIES][4];

static void read_table(entire_transfer_function *tf) {
    OK(entire_transfer_function_table(tf, &rgba[0][0], 4 * ENTRIES));
}

static void lobes(void) {
    const entire_gaussian_lobe two[] = {{0.3f, 0.01f, 0.5f}, {0.8f, 0.002f, 0.9f}};
    entire_transfer_function *tf = NULL;
    OK(entire_transfer_function_from_lobes(two, 2, &tf));
    read_table(tf);
    for (int i = 0; i < ENTRIES; ++i) {
        const double s = i / 255.0;
        const double o = 0.5 * exp(-(s - 0.3) * (s - 0.3) / 0.01) + 0.9 * exp(-(s - 0.8) * (s - 0.8) / 0.002);
        CHECK(fabs((double)rgba[i][3] - o) < 1e-5);
    }
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_table(tf, &rgba[0][0], 4 * ENTRIES - 1));
    SAYS("1023");
    entire_transfer_function_free(tf);

    OK(entire_transfer_function_from_lobes(NULL, 0, &tf));
    read_table(tf);
    for (int i = 0; i < ENTRIES; ++i) CHECK(rgba[i][3] == 0);
    entire_transfer_function_free(tf);
    tf = NULL;

    const entire_gaussian_lobe bad[] = {{NAN, 1, 1}, {0, 0, 1}, {0, -1, 1}, {0, 1, -1}, {0, 1, INFINITY}, {0, NAN, 1}};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; ++i) {
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_lobes(&bad[i], 1, &tf));
        SAYS("lobe 0");
    }
    EXPECT(ENTIRE_NULL_ARGUMENT, entire_transfer_function_from_lobes(NULL, 1, &tf));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_from_lobes(two, SIZE_MAX, &tf));
    CHECK(tf == NULL);
}

/* Values of VTK 9.7: vtkPiecewiseFunction and vtkColorTransferFunction between (0, 0) and (1, 1) with midpoint 0.5.
 * Tests of the core compare whole tables. */
static void nodes(void) {
    static const struct {
        double sharpness, opacity[5], color[5]; /* at 0.2, 0.4, 0.5, 0.6, 0.8 */
    } vtk[] = {
        {0.0, {0.2, 0.4, 0.5, 0.6, 0.8}, {0.2, 0.4, 0.5, 0.6, 0.8}},
        {0.01, {0.1815413, 0.3906548, 0.5, 0.6093452, 0.8184587}, {0.1815413, 0.3906548, 0.5, 0.6093452, 0.8184587}},
        {0.5, {0.0010303, 0.089054, 0.5, 0.910946, 0.9989697}, {0.0010303, 0.089054, 0.5, 0.910946, 0.9989697}},
        {1.0, {0.0, 0.0053756, 0.5, 0.9946244, 1.0}, {0, 0, 1, 1, 1}},
    };
    static const int tenth[] = {2, 4, 5, 6, 8};
    for (size_t i = 0; i < sizeof vtk / sizeof vtk[0]; ++i)
        for (int k = 0; k < 5; ++k) {
            const entire_opacity_node opacity[] = {{0, 0, 0.5, vtk[i].sharpness}, {1, 1, 0.5, 0}};
            const entire_color_node color[] = {{0, {0, 0, 0}, 0.5, vtk[i].sharpness}, {1, {1, 1, 1}, 0.5, 0}};
            /* A range of zero width at x: every entry of the table is the value there. */
            const double x = tenth[k] / 10.0;
            entire_transfer_function *tf = NULL;
            OK(entire_transfer_function_from_nodes(opacity, 2, color, 2, x, x, 1, &tf));
            read_table(tf);
            CHECK(fabs((double)rgba[0][3] - vtk[i].opacity[k]) < 2e-7 + 1e-7);
            CHECK(fabs((double)rgba[255][1] - vtk[i].color[k]) < 2e-7 + 1e-7);
            entire_transfer_function_free(tf);
        }

    const entire_opacity_node ends[] = {{40, 0.25, 0.5, 0}, {60, 0.75, 0.5, 0}};
    entire_transfer_function *tf = NULL;
    OK(entire_transfer_function_from_nodes(ends, 2, NULL, 0, 0, 100, 1, &tf));
    read_table(tf);
    CHECK(rgba[0][3] == 0.25f && rgba[255][3] == 0.75f && rgba[0][0] != rgba[255][0]);
    entire_transfer_function_free(tf);
    OK(entire_transfer_function_from_nodes(ends, 2, NULL, 0, 0, 100, 0, &tf));
    read_table(tf);
    CHECK(rgba[0][3] == 0 && rgba[255][3] == 0 && rgba[128][3] > 0.5f);
    entire_transfer_function_free(tf);
    tf = NULL;

    const entire_opacity_node bad[] = {{NAN, 0, 0.5, 0}, {0, 1.5, 0.5, 0}, {0, 0, 2, 0}, {0, 0, 0.5, -1}};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; ++i)
        EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_nodes(&bad[i], 1, NULL, 0, 0, 1, 1, &tf));
    const entire_opacity_node unsorted[] = {{1, 0, 0.5, 0}, {0, 0, 0.5, 0}};
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_nodes(unsorted, 2, NULL, 0, 0, 1, 1, &tf));
    SAYS("sort");
    const entire_color_node red = {0, {2, 0, 0}, 0.5, 0};
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_nodes(ends, 2, &red, 1, 0, 1, 1, &tf));
    SAYS("color node 0");
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_nodes(ends, 2, NULL, 0, 1, 0, 1, &tf));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_nodes(ends, 2, NULL, 0, 0, INFINITY, 1, &tf));
    CHECK(tf == NULL);
}

static void tables(void) {
    float given[ENTRIES][4];
    for (int i = 0; i < ENTRIES; ++i)
        for (int c = 0; c < 4; ++c) given[i][c] = (float)((i * 7 + c * 31) % 256) / 255;
    entire_transfer_function *tf = NULL;
    OK(entire_transfer_function_from_table(&given[0][0], ENTRIES, &tf));
    read_table(tf);
    CHECK(memcmp(given, rgba, sizeof given) == 0);
    entire_transfer_function_free(tf);
    OK(entire_transfer_function_from_table(&given[0][0], 2, &tf));
    read_table(tf);
    CHECK(fabsf(rgba[51][2] - (0.8f * given[0][2] + 0.2f * given[1][2])) < 1e-6f);
    entire_transfer_function_free(tf);
    tf = NULL;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_table(&given[0][0], 1, &tf));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_table(NULL, 0, &tf));
    EXPECT(ENTIRE_SIZE_MISMATCH, entire_transfer_function_from_table(&given[0][0], SIZE_MAX / 4, &tf));
    given[3][3] = 1.5f;
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_from_table(&given[0][0], ENTRIES, &tf));
    CHECK(tf == NULL);
}

/* A unit distance of k smallest spacings in world units means the same as k reference steps: predictions are equal, bit
 * by bit. */
static void unit_distances(void) {
    float seconds[3];
    for (int i = 0; i < 3; ++i) {
        entire_volume *volume = NULL;
        uint8_t voxels[TOY_VOXELS];
        memset(voxels, 128, sizeof voxels);
        entire_volume_desc desc;
        OK(entire_volume_desc_init(&desc, sizeof desc));
        desc.scalar_type = ENTIRE_SCALAR_U8;
        desc.voxels = voxels;
        desc.voxel_count = TOY_VOXELS;
        desc.dims[0] = TOY_X, desc.dims[1] = TOY_Y, desc.dims[2] = TOY_Z;
        desc.spacing[0] = 4, desc.spacing[1] = 0.5f, desc.spacing[2] = 1;
        OK(entire_volume_new(&desc, &volume));
        entire_transfer_function *tf = toy_transfer_function();
        if (i == 1) OK(entire_transfer_function_set_unit_distance(tf, 2, ENTIRE_UNIT_WORLD));
        if (i == 2) OK(entire_transfer_function_set_unit_distance(tf, 4, ENTIRE_UNIT_REFERENCE_STEP));
        entire_session *session = NULL;
        OK(entire_session_new(NULL, NULL, &session));
        EXPECT(ENTIRE_NOT_READY, entire_session_set_transfer_function(session, tf));
        OK(entire_session_set_volume(session, volume));
        OK(entire_session_set_transfer_function(session, tf));
        entire_frame frame = toy_frame();
        entire_prediction prediction = {.struct_size = sizeof prediction};
        OK(entire_session_predict(session, &frame, &prediction));
        seconds[i] = prediction.seconds;
        entire_session_free(session);
        entire_transfer_function_free(tf);
        entire_volume_free(volume);
    }
    CHECK(seconds[1] == seconds[2] && seconds[0] != seconds[1]);

    entire_transfer_function *tf = toy_transfer_function();
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_set_unit_distance(tf, 0, ENTIRE_UNIT_WORLD));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_set_unit_distance(tf, NAN, ENTIRE_UNIT_WORLD));
    EXPECT(ENTIRE_INVALID_ARGUMENT, entire_transfer_function_set_unit_distance(tf, 1, 3));
    SAYS("unit is 3");
    entire_transfer_function_free(tf);
    entire_transfer_function_free(NULL);
}

int main(void) {
    lobes();
    nodes();
    tables();
    unit_distances();
    return 0;
}
