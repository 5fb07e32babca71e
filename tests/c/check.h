/* Shared parts of the tests: checks that print file, line and reason of a failure, and a small scene. */
#ifndef ENTIRE_TESTS_CHECK_H
#define ENTIRE_TESTS_CHECK_H

#include <entire/advanced.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(condition)                                                                               \
    do {                                                                                               \
        if (!(condition)) {                                                                            \
            fprintf(stderr, "%s:%d: %s is false; last error: %s\n", __FILE__, __LINE__, #condition,    \
                    entire_last_error());                                                              \
            exit(1);                                                                                   \
        }                                                                                              \
    } while (0)

/* Checks that the call returns this code, and that there is an error text if and only if the call failed. */
#define EXPECT(code, call)                                                                             \
    do {                                                                                               \
        entire_result expect_found_ = (call);                                                          \
        if (expect_found_ != (code)) {                                                                 \
            fprintf(stderr, "%s:%d: %s gives %s, expected %s; last error: %s\n", __FILE__, __LINE__,   \
                    #call, entire_result_name(expect_found_), entire_result_name(code),                \
                    entire_last_error());                                                              \
            exit(1);                                                                                   \
        }                                                                                              \
        CHECK((entire_last_error()[0] != '\0') == ((code) != ENTIRE_OK));                              \
    } while (0)

#define OK(call) EXPECT(ENTIRE_OK, call)

/* Checks that the text of the last failure contains these words. */
#define SAYS(words) CHECK(strstr(entire_last_error(), words) != NULL)

enum { TOY_X = 5, TOY_Y = 7, TOY_Z = 11, TOY_VOXELS = TOY_X * TOY_Y * TOY_Z };

static inline void *read_file(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    CHECK(file != NULL);
    CHECK(fseek(file, 0, SEEK_END) == 0);
    long length = ftell(file);
    CHECK(length > 0);
    rewind(file);
    void *bytes = malloc((size_t)length);
    CHECK(bytes != NULL);
    *size = fread(bytes, 1, (size_t)length, file);
    CHECK(*size == (size_t)length);
    fclose(file);
    return bytes;
}

/* 5 x 7 x 11 bytes with three different spacings, so that swapped axes are noticed. */
static inline entire_volume *toy_volume(void) {
    uint8_t voxels[TOY_VOXELS];
    for (int i = 0; i < TOY_VOXELS; ++i) voxels[i] = (uint8_t)(i * 37 % 256);
    entire_volume_desc desc;
    OK(entire_volume_desc_init(&desc, sizeof desc));
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.voxels = voxels;
    desc.voxel_count = TOY_VOXELS;
    desc.dims[0] = TOY_X;
    desc.dims[1] = TOY_Y;
    desc.dims[2] = TOY_Z;
    desc.spacing[0] = 1;
    desc.spacing[1] = 2;
    desc.spacing[2] = 7;
    entire_volume *volume = NULL;
    OK(entire_volume_new(&desc, &volume));
    return volume;
}

static inline entire_transfer_function *toy_transfer_function(void) {
    const entire_gaussian_lobe lobe = {0.5f, 0.05f, 0.3f};
    entire_transfer_function *tf = NULL;
    OK(entire_transfer_function_from_lobes(&lobe, 1, &tf));
    return tf;
}

static inline entire_frame toy_frame(void) {
    entire_frame frame;
    OK(entire_frame_init(&frame, sizeof frame));
    frame.width = 96;
    frame.height = 64;
    return frame;
}

/* A session with a volume and the toy transfer function; `model` and `options` may be NULL. */
static inline entire_session *session_of(const entire_model *model, const entire_session_options *options,
                                         const entire_volume *volume) {
    entire_transfer_function *tf = toy_transfer_function();
    entire_session *session = NULL;
    OK(entire_session_new(model, options, &session));
    OK(entire_session_set_volume(session, volume));
    OK(entire_session_set_transfer_function(session, tf));
    entire_transfer_function_free(tf);
    return session;
}

static inline entire_session *toy_session_with(const entire_model *model, const entire_session_options *options) {
    entire_volume *volume = toy_volume();
    entire_session *session = session_of(model, options, volume);
    entire_volume_free(volume);
    return session;
}

static inline entire_session *toy_session(const entire_model *model) {
    return toy_session_with(model, NULL);
}

#endif
