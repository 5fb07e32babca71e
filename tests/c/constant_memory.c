/* Plans and observations do not grow memory: between the first tenth of the loop and its end, the resident set grows by
 * at most 16 pages, and the size of the heap in use does not change. Not for builds with a sanitizer, whose own
 * bookkeeping grows.
 *
 *   constant_memory MODEL ROUNDS
 */
#define _GNU_SOURCE
#include "check.h"
#include <malloc.h>
#include <unistd.h>

static long resident_pages(void) {
    long size = 0, resident = 0;
    FILE *file = fopen("/proc/self/statm", "r");
    CHECK(file != NULL);
    CHECK(fscanf(file, "%ld %ld", &size, &resident) == 2);
    fclose(file);
    return resident;
}

int main(int argc, char **argv) {
    CHECK(argc == 3);
    const long rounds = strtol(argv[2], NULL, 10);
    entire_model *model = NULL;
    OK(entire_model_open(argv[1], &model));
    entire_session *session = toy_session(model);
    entire_frame frame = toy_frame();
    frame.width = frame.height = 16;
    long pages = 0;
    size_t heap = 0;
    for (long i = 0; i < rounds; ++i) {
        entire_plan plan = {.struct_size = sizeof plan};
        frame.arcball[1] = (float)(i % 360);
        entire_result planned = entire_session_plan(session, &frame, 0.01f, &plan);
        entire_result observed = entire_session_observe(session, plan.id, 0.001f + 0.02f / plan.step, 0, NULL);
        CHECK(planned == ENTIRE_OK && observed == ENTIRE_OK);
        if (i == rounds / 10) {
            pages = resident_pages();
            heap = mallinfo2().uordblks;
        }
    }
    const size_t heap_now = mallinfo2().uordblks;
    const long grown = resident_pages() - pages;
    printf("%ld rounds: heap %zu bytes after a tenth, %zu at the end; resident set grew by %ld pages\n", rounds, heap,
           heap_now, grown);
    CHECK(heap == heap_now);
    CHECK(grown <= 16);
    entire_session_free(session);
    entire_model_free(model);
    return 0;
}
