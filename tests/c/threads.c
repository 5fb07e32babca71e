/* Eight threads share one model, one volume and one transfer function; each has its own session. Predictions of all
 * threads have the same bits; a failing thread reads its own error. */
#include "check.h"
#include <pthread.h>

enum { THREADS = 8, ROUNDS = 2000, COLUMNS = 11 };

static entire_model *model;
static entire_volume *volume;
static entire_transfer_function *tf;
static float wanted[64];

static void inputs_of(int i, float *inputs) {
    const float values[COLUMNS] = {0.1f, -0.2f, 20, (float)i, 3, 256, 128, 0.5f, 0.02f, 0.4f, 1 + 0.1f * (float)i};
    memcpy(inputs, values, sizeof values);
}

static void *work(void *argument) {
    const int me = *(const int *)argument;
    entire_session *session = NULL;
    entire_frame frame = toy_frame();
    frame.arcball[1] = (float)me * 20;
    OK(entire_session_new(model, NULL, &session));
    OK(entire_session_set_volume(session, volume));
    OK(entire_session_set_transfer_function(session, tf));
    for (int round = 0; round < ROUNDS; ++round) {
        float inputs[COLUMNS], seconds = 0;
        inputs_of(round % 64, inputs);
        OK(entire_model_predict(model, inputs, COLUMNS, &seconds));
        CHECK(seconds == wanted[round % 64]);
        if (round % 16 == 0) {
            entire_plan plan = {.struct_size = sizeof plan};
            OK(entire_session_plan(session, &frame, 0.02f, &plan));
            OK(entire_session_observe(session, plan.id, 0.01f + 0.001f * (float)(round % 7), 0, NULL));
            EXPECT(ENTIRE_SIZE_MISMATCH, entire_model_predict(model, inputs, (size_t)me, &seconds));
            char mine[40];
            snprintf(mine, sizeof mine, "%d inputs in 1 row", me);
            SAYS(mine);
        }
        if (round % 500 == 0) {
            float features[2];
            size_t count = 0;
            OK(entire_model_encode(model, volume, features, 2, &count));
        }
    }
    entire_session_free(session);
    return NULL;
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    OK(entire_model_open(argv[1], &model));
    volume = toy_volume();
    tf = toy_transfer_function();
    for (int i = 0; i < 64; ++i) {
        float inputs[COLUMNS];
        inputs_of(i, inputs);
        OK(entire_model_predict(model, inputs, COLUMNS, &wanted[i]));
    }
    pthread_t threads[THREADS];
    int numbers[THREADS];
    for (int i = 0; i < THREADS; ++i) {
        numbers[i] = i;
        CHECK(pthread_create(&threads[i], NULL, work, &numbers[i]) == 0);
    }
    for (int i = 0; i < THREADS; ++i) CHECK(pthread_join(threads[i], NULL) == 0);
    entire_transfer_function_free(tf);
    entire_volume_free(volume);
    entire_model_free(model);
    return 0;
}
