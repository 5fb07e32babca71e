/* Makes allocations fail in every kind of call, one after the other and all at once: no failure may end the process.
 * Calls marked as hot allocate nothing. A call that allocates a size declared by the caller returns
 * ENTIRE_OUT_OF_MEMORY if that allocation fails. Small allocations that fail are served from the library's reserve;
 * while more than half of the reserve is in use, calls that make a handle or keep further memory return
 * ENTIRE_OUT_OF_MEMORY, too.
 *
 *   alloc_failure MODEL
 *
 * This program's malloc replaces that of the C library: while `watching` is set, request number `fail_at` fails, and so
 * does every request of at least `fail_from` bytes (if that is not 0).
 */
#define _GNU_SOURCE
#include "check.h"
#include <errno.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

extern void *__libc_malloc(size_t);
extern void *__libc_calloc(size_t, size_t);
extern void *__libc_realloc(void *, size_t);
extern void *__libc_memalign(size_t, size_t);

static int watching;
static long requests, fail_at;
static size_t fail_from;

static int fails(size_t size) {
    if (!watching) return 0;
    requests += 1;
    if (requests == fail_at || (fail_from != 0 && size >= fail_from)) {
        errno = ENOMEM;
        return 1;
    }
    return 0;
}

void *malloc(size_t size) {
    return fails(size) ? NULL : __libc_malloc(size);
}

void *calloc(size_t count, size_t size) {
    return fails(count * size) ? NULL : __libc_calloc(count, size);
}

void *realloc(void *old, size_t size) {
    return fails(size) ? NULL : __libc_realloc(old, size);
}

int posix_memalign(void **out, size_t alignment, size_t size) {
    if (fails(size)) return ENOMEM;
    void *made = __libc_memalign(alignment, size);
    if (made == NULL) return ENOMEM;
    *out = made;
    return 0;
}

void *aligned_alloc(size_t alignment, size_t size) {
    return fails(size) ? NULL : __libc_memalign(alignment, size);
}

/* Side and number of voxels of the large volume; rows and columns of the batch. */
enum { SIDE = 64, LARGE = SIDE * SIDE * SIDE, ROWS = 100000, COLUMNS = 11 };

static uint8_t *model_bytes;
static size_t model_size;
static const char *model_path;
static uint8_t large[LARGE];
static float rows[ROWS * COLUMNS], seconds[ROWS];
static entire_model *model;
static entire_volume *volume;
static entire_transfer_function *tf;
static entire_session *session, *trained;
static entire_frame frame;
static uint64_t plan_id;

static entire_result open_model(void) {
    entire_model *made = NULL;
    entire_result result = entire_model_open(model_path, &made);
    entire_model_free(made);
    return result;
}

static entire_result model_from_bytes(void) {
    entire_model *made = NULL;
    entire_result result = entire_model_from_bytes(model_bytes, model_size, &made);
    entire_model_free(made);
    return result;
}

static entire_volume_desc large_volume(entire_voxels_ownership ownership) {
    entire_volume_desc desc;
    entire_volume_desc_init(&desc, sizeof desc);
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.ownership = ownership;
    desc.voxels = large;
    desc.voxel_count = LARGE;
    desc.dims[0] = desc.dims[1] = desc.dims[2] = SIDE;
    return desc;
}

static entire_result new_volume(void) {
    const entire_volume_desc desc = large_volume(ENTIRE_VOXELS_COPY);
    entire_volume *made = NULL;
    entire_result result = entire_volume_new(&desc, &made);
    entire_volume_free(made);
    return result;
}

static entire_result new_session(void) {
    entire_session *made = NULL;
    entire_result result = entire_session_new(model, NULL, &made);
    entire_session_free(made);
    return result;
}

static entire_result set_features(void) {
    return entire_volume_set_features(volume, rows, ROWS);
}

static entire_result lobes(void) {
    const entire_gaussian_lobe lobe = {0.5f, 0.05f, 0.3f};
    entire_transfer_function *made = NULL;
    entire_result result = entire_transfer_function_from_lobes(&lobe, 1, &made);
    entire_transfer_function_free(made);
    return result;
}

static entire_result set_volume(void) {
    return entire_session_set_volume(session, volume);
}

/* Makes a volume, updates it twice, and sets the volume and its time step in a session. */
static entire_result update_volume(void) {
    const entire_volume_desc desc = large_volume(ENTIRE_VOXELS_BORROW);
    entire_volume *made = NULL;
    entire_result result = entire_volume_new(&desc, &made);
    if (result == ENTIRE_OK) result = entire_volume_update(made, &desc);
    if (result == ENTIRE_OK) result = entire_volume_update(made, &desc);
    if (result == ENTIRE_OK) result = entire_session_set_volume(session, made);
    if (result == ENTIRE_OK) result = entire_session_set_time_step(session, made);
    entire_volume_free(made);
    return result;
}

static entire_result set_transfer_function(void) {
    return entire_session_set_transfer_function(session, tf);
}

static entire_result set_timing_source(void) {
    return entire_session_set_timing_source(session, "a renderer", "wall");
}

static entire_result set_unit_distance(void) {
    return entire_transfer_function_set_unit_distance(tf, 2, ENTIRE_UNIT_WORLD);
}

static entire_result predict_batch(void) {
    return entire_model_predict_batch(model, rows, ROWS, COLUMNS, seconds);
}

static entire_result encode(void) {
    float features[2];
    size_t count = 0;
    return entire_model_encode(model, volume, features, 2, &count);
}

static entire_result save_state(void) {
    static uint8_t buffer[1 << 16];
    size_t count = 0;
    return entire_session_save_state(trained, buffer, sizeof buffer, &count);
}

static entire_result refused(void) {
    return entire_session_plan(session, &frame, -1, NULL) == ENTIRE_OK ? ENTIRE_PANIC : ENTIRE_OK;
}

static entire_result predict(void) {
    float one = 0;
    return entire_model_predict(model, rows, COLUMNS, &one);
}

static entire_result session_predict(void) {
    entire_prediction prediction = {.struct_size = sizeof prediction};
    return entire_session_predict(trained, &frame, &prediction);
}

static entire_result plan(void) {
    entire_plan made = {.struct_size = sizeof made};
    entire_result result = entire_session_plan(trained, &frame, 0.02f, &made);
    if (result == ENTIRE_OK) plan_id = made.id;
    return result;
}

static entire_result choose(void) {
    const entire_setting settings[] = {{1, 96, 64, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS},
                                       {4, 48, 32, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS}};
    entire_plan made = {.struct_size = sizeof made};
    size_t index = 0;
    return entire_session_choose(trained, &frame, settings, 2, 0.02f, &index, &made);
}

static entire_result observe(void) {
    return entire_session_observe(trained, plan_id, 0.01f, 0, NULL);
}

static entire_result plan_and_withdraw(void) {
    entire_result result = plan();
    return result == ENTIRE_OK ? entire_session_withdraw(trained, plan_id) : result;
}

static entire_result plan_and_observe(void) {
    entire_result result = plan();
    return result == ENTIRE_OK ? observe() : result;
}

/* Makes handles while every request fails: they are served from the reserve until more than half of it is in
 * use; then further handles are refused. After all are freed, handles can be made again. */
static entire_result fill_the_reserve(void) {
    enum { MOST = 10000 };
    static entire_transfer_function *held[MOST];
    const entire_gaussian_lobe lobe = {0.5f, 0.05f, 0.3f};
    for (int round = 0; round < 3; ++round) {
        int made = 0;
        entire_result result = ENTIRE_OK;
        while (made < MOST && (result = entire_transfer_function_from_lobes(&lobe, 1, &held[made])) == ENTIRE_OK) made += 1;
        if (made < 20 || made == MOST || result != ENTIRE_OUT_OF_MEMORY) return ENTIRE_PANIC;
        if (strstr(entire_last_error(), "memory") == NULL) return ENTIRE_PANIC;
        if (open_model() != ENTIRE_OUT_OF_MEMORY || plan_and_observe() != ENTIRE_OK) return ENTIRE_PANIC;
        if (set_timing_source() != ENTIRE_OUT_OF_MEMORY) return ENTIRE_PANIC;
        if (set_unit_distance() != ENTIRE_OUT_OF_MEMORY) return ENTIRE_PANIC;
        while (made > 0) entire_transfer_function_free(held[--made]);
    }
    return ENTIRE_OK;
}

static const struct {
    const char *name;
    entire_result (*call)(void);
    /* 1 for a call that allocates nothing. */
    int hot;
    /* Size in bytes that the caller declares; when requests of at least this size fail, the call returns
     * ENTIRE_OUT_OF_MEMORY. 0: no such size. */
    size_t declared;
} calls[] = {
    {"entire_model_predict", predict, 1, 0},
    {"entire_session_predict", session_predict, 1, 0},
    {"entire_session_plan", plan, 1, 0},
    {"entire_session_choose", choose, 1, 0},
    {"entire_session_plan, entire_session_observe", plan_and_observe, 1, 0},
    {"entire_session_plan, entire_session_withdraw", plan_and_withdraw, 1, 0},
    {"entire_model_encode, from its second call on", encode, 1, 0},
    {"entire_volume_set_features", set_features, 0, ROWS * sizeof(float)},
    {"entire_volume_new", new_volume, 0, LARGE},
    {"entire_model_predict_batch", predict_batch, 0, ROWS * sizeof(float)},
    {"entire_model_open", open_model, 0, 0},
    {"entire_model_from_bytes", model_from_bytes, 0, 0},
    {"entire_transfer_function_from_lobes", lobes, 0, 0},
    {"entire_session_new", new_session, 0, 0},
    {"entire_session_set_volume", set_volume, 0, 0},
    {"entire_volume_update, entire_session_set_time_step", update_volume, 0, 0},
    {"entire_session_set_transfer_function", set_transfer_function, 0, 0},
    {"entire_session_set_timing_source", set_timing_source, 0, 0},
    {"entire_transfer_function_set_unit_distance", set_unit_distance, 0, 0},
    {"entire_session_save_state", save_state, 0, 0},
    {"a refused call", refused, 0, 0},
};

/* Outcome of a call in a child process in which requests failed: DONE if the call returned ENTIRE_OK, ANSWERED if it
 * returned an error code. */
enum ending { DONE, ANSWERED };

static enum ending in_child(entire_result (*call)(void), long n, size_t from, long *made, entire_result *answer) {
    int ends[2];
    CHECK(pipe(ends) == 0);
    const pid_t child = fork();
    CHECK(child >= 0);
    if (child == 0) {
        const struct rlimit no_core = {0, 0};
        setrlimit(RLIMIT_CORE, &no_core);
        if (freopen("/dev/null", "w", stderr) == NULL) _exit(3);
        requests = 0, fail_at = n, fail_from = from, watching = 1;
        const entire_result result = call();
        watching = 0;
        const long said[2] = {(long)result, requests};
        _exit(write(ends[1], said, sizeof said) == sizeof said ? 0 : 3);
    }
    close(ends[1]);
    long said[2] = {-1, 0};
    const ssize_t got = read(ends[0], said, sizeof said);
    close(ends[0]);
    int status = 0;
    CHECK(waitpid(child, &status, 0) == child);
    CHECK(!WIFSIGNALED(status));
    CHECK(WEXITSTATUS(status) == 0 && got == (ssize_t)sizeof said);
    *answer = (entire_result)said[0];
    *made = said[1];
    CHECK(*answer != ENTIRE_PANIC);
    return *answer == ENTIRE_OK ? DONE : ANSWERED;
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    model_path = argv[1];
    model_bytes = read_file(argv[1], &model_size);
    for (int i = 0; i < LARGE; ++i) large[i] = (uint8_t)(i * 37);
    for (int i = 0; i < ROWS * COLUMNS; ++i) rows[i] = 0.01f * (float)(i % 100);
    OK(entire_model_from_bytes(model_bytes, model_size, &model));
    volume = toy_volume();
    tf = toy_transfer_function();
    session = toy_session(NULL);
    trained = toy_session(model);
    frame = toy_frame();
    /* These calls make the objects that the library makes at their first use and then keeps. */
    OK(plan_and_observe());
    OK(encode());
    OK(predict_batch());

    long answered = 0, served = 0;
    for (size_t c = 0; c < sizeof calls / sizeof calls[0]; ++c) {
        long made = 0, unused = 0;
        entire_result answer = ENTIRE_OK;
        CHECK(in_child(calls[c].call, 0, 0, &made, &answer) == DONE);
        CHECK(calls[c].hot ? made == 0 : made > 0);
        if (calls[c].declared) {
            CHECK(in_child(calls[c].call, 0, calls[c].declared, &unused, &answer) == ANSWERED);
            CHECK(answer == ENTIRE_OUT_OF_MEMORY);
        }
        /* Every request fails: a call that the reserve cannot serve returns ENTIRE_OUT_OF_MEMORY. */
        if (in_child(calls[c].call, 0, 1, &unused, &answer) == ANSWERED) CHECK(answer == ENTIRE_OUT_OF_MEMORY);
        /* One request fails: each request is tried, or up to 200 evenly spaced ones if there are 200 or more. */
        const long stride = made / 200 + 1;
        for (long n = 1; n <= made; n += stride) {
            if (in_child(calls[c].call, n, 0, &unused, &answer) == DONE) {
                served += 1;
            } else {
                CHECK(answer == ENTIRE_OUT_OF_MEMORY);
                answered += 1;
            }
        }
        printf("%-45s %6ld allocations\n", calls[c].name, made);
    }
    printf("%ld failures answered with a code, %ld served by the reserve, none ended the process\n", answered, served);
    CHECK(in_child(fill_the_reserve, 0, 1, &answered, &(entire_result){ENTIRE_OK}) == DONE);
    entire_session_free(session);
    entire_session_free(trained);
    entire_transfer_function_free(tf);
    entire_volume_free(volume);
    entire_model_free(model);
    free(model_bytes);
    return 0;
}
