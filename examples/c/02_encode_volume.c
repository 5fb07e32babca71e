/* Makes a volume of 16-bit voxels and encodes it into the features that are inputs of the model's predictions. The
 * features depend on the volume alone: compute them once, store them, and set them in later runs.
 *
 *   02_encode_volume MODEL.safetensors
 */
#include <entire/advanced.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

enum { NX = 60, NY = 44, NZ = 30 };
static uint16_t voxels[NZ][NY][NX];

static void check(entire_result result) {
    if (result != ENTIRE_OK) {
        fprintf(stderr, "%s: %s\n", entire_result_name(result), entire_last_error());
        exit(1);
    }
}

/* Fills `voxels` with an ellipsoid whose values fall to 0 at its surface. */
static void make_voxels(void) {
    for (int z = 0; z < NZ; ++z)
        for (int y = 0; y < NY; ++y)
            for (int x = 0; x < NX; ++x) {
                float u = 2.0f * (float)x / (NX - 1) - 1, v = 2.0f * (float)y / (NY - 1) - 1;
                float w = 2.0f * (float)z / (NZ - 1) - 1, r = u * u + v * v + w * w;
                voxels[z][y][x] = (uint16_t)(r < 1 ? 4095 * (1 - r) : 0);
            }
}

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: %s MODEL.safetensors\n", argv[0]), 2;
    make_voxels();

    entire_volume_desc desc;
    check(entire_volume_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U16;
    desc.ownership = ENTIRE_VOXELS_BORROW; /* the volume makes no copy: `voxels` outlives it */
    desc.voxels = voxels;
    desc.voxel_count = sizeof voxels / sizeof voxels[0][0][0];
    desc.dims[0] = NX, desc.dims[1] = NY, desc.dims[2] = NZ;
    desc.spacing[2] = 2; /* slices twice as far apart as pixels */
    desc.range[0] = 0, desc.range[1] = 4095;
    entire_volume *volume = NULL;
    check(entire_volume_new(&desc, &volume));

    entire_volume_info about = {.struct_size = sizeof about};
    check(entire_volume_describe(volume, &about));
    printf("%zu x %zu x %zu voxels, bounding radius %g, reference step %g\n", about.dims[0], about.dims[1],
           about.dims[2], about.bounding_radius, about.reference_step);

    entire_model *model = NULL;
    check(entire_model_open(argv[1], &model));
    entire_model_info info = {.struct_size = sizeof info};
    check(entire_model_describe(model, &info));
    if (info.feature_count == 0) return fprintf(stderr, "the file has no volume encoder\n"), 1;

    float *features = malloc(info.feature_count * sizeof *features);
    size_t count = 0;
    if (!features) return 1;
    check(entire_model_encode(model, volume, features, info.feature_count, &count));
    printf("%zu features:", count);
    for (size_t i = 0; i < count; ++i) printf(" %.6g", features[i]);
    printf("\n");

    /* A session does not encode a volume whose features are set. Later runs can set stored features here. */
    check(entire_volume_set_features(volume, features, count));

    free(features);
    entire_model_free(model);
    entire_volume_free(volume);
    return 0;
}
