/* Calls every function with NULL for each of its pointers that must not be NULL, one at a time. tests/c/run.sh checks
 * that no function is missing. */
#include "check.h"

#define NONE(call) EXPECT(ENTIRE_NULL_ARGUMENT, call)

int main(int argc, char **argv) {
    CHECK(argc == 2);
    entire_model *m = NULL;
    entire_volume *v = toy_volume();
    entire_transfer_function *t = toy_transfer_function();
    entire_session *p = toy_session(NULL);
    OK(entire_model_open(argv[1], &m));

    float f[16] = {0};
    size_t n = 0;
    uint8_t byte = 0;
    entire_frame frame = toy_frame();
    entire_plan plan = {.struct_size = sizeof plan};
    entire_prediction prediction = {.struct_size = sizeof prediction};
    entire_model_info info = {.struct_size = sizeof info};
    entire_input_group group = {.struct_size = sizeof group};
    entire_volume_info volume_info = {.struct_size = sizeof volume_info};
    entire_volume_desc desc;
    entire_brick_desc bricks;
    OK(entire_volume_desc_init(&desc, sizeof desc));
    OK(entire_brick_desc_init(&bricks, sizeof bricks));
    const entire_setting setting = {1, 1, 1, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_NONE};
    const entire_opacity_node node = {0, 0, 0.5, 0};
    const entire_gaussian_lobe lobe = {0.5f, 0.1f, 0.1f};
    entire_model *made_model = NULL;
    entire_volume *made_volume = NULL;
    entire_transfer_function *made_tf = NULL;
    entire_session *made_session = NULL;

    /* Functions without pointer arguments. */
    entire_version();
    entire_version_number();
    entire_abi_version();
    entire_simd_level();
    entire_result_name(0);
    entire_last_error();

    NONE(entire_model_open(NULL, &made_model));
    NONE(entire_model_open(argv[1], NULL));
    NONE(entire_model_open_machine(ENTIRE_SHADING_NONE, NULL));
    NONE(entire_model_from_bytes(NULL, 8, &made_model));
    NONE(entire_model_from_bytes(&byte, 1, NULL));
    NONE(entire_model_describe(NULL, &info));
    NONE(entire_model_describe(m, NULL));
    NONE(entire_model_input_group(NULL, 0, &group));
    NONE(entire_model_input_group(m, 0, NULL));
    CHECK(entire_model_scene_feature(NULL, 0) == NULL);
    CHECK(entire_model_metadata(NULL, "entire.device") == NULL);
    CHECK(entire_model_metadata(m, NULL) == NULL);
    NONE(entire_model_encode(NULL, v, f, 16, &n));
    NONE(entire_model_encode(m, NULL, f, 16, &n));
    NONE(entire_model_encode(m, v, NULL, 16, &n));
    NONE(entire_model_encode(m, v, f, 16, NULL));
    NONE(entire_model_predict(NULL, f, 11, f));
    NONE(entire_model_predict(m, NULL, 11, f));
    NONE(entire_model_predict(m, f, 11, NULL));
    NONE(entire_model_predict_batch(NULL, f, 1, 11, f));
    NONE(entire_model_predict_batch(m, NULL, 1, 11, f));
    NONE(entire_model_predict_batch(m, f, 1, 11, NULL));
    entire_model_free(NULL);

    NONE(entire_volume_desc_init(NULL, sizeof desc));
    NONE(entire_brick_desc_init(NULL, sizeof bricks));
    NONE(entire_volume_new(NULL, &made_volume));
    NONE(entire_volume_new(&desc, NULL));
    NONE(entire_volume_new(&desc, &made_volume));
    NONE(entire_volume_from_bricks(NULL, &made_volume));
    NONE(entire_volume_from_bricks(&bricks, NULL));
    NONE(entire_volume_set_features(NULL, f, 1));
    NONE(entire_volume_set_features(v, NULL, 1));
    const size_t place[3] = {0, 0, 0};
    NONE(entire_volume_update(NULL, &desc));
    NONE(entire_volume_update(v, NULL));
    NONE(entire_volume_update_box(NULL, &desc, place, place));
    NONE(entire_volume_update_box(v, NULL, place, place));
    NONE(entire_volume_update_box(v, &desc, NULL, place));
    NONE(entire_volume_update_box(v, &desc, place, NULL));
    NONE(entire_volume_describe(NULL, &volume_info));
    NONE(entire_volume_describe(v, NULL));
    entire_volume_free(NULL);

    NONE(entire_transfer_function_from_lobes(NULL, 1, &made_tf));
    NONE(entire_transfer_function_from_lobes(&lobe, 1, NULL));
    NONE(entire_transfer_function_from_nodes(NULL, 1, NULL, 0, 0, 1, 1, &made_tf));
    NONE(entire_transfer_function_from_nodes(&node, 1, NULL, 1, 0, 1, 1, &made_tf));
    NONE(entire_transfer_function_from_nodes(&node, 1, NULL, 0, 0, 1, 1, NULL));
    NONE(entire_transfer_function_from_table(NULL, 2, &made_tf));
    NONE(entire_transfer_function_from_table(f, 2, NULL));
    NONE(entire_transfer_function_set_unit_distance(NULL, 1, ENTIRE_UNIT_WORLD));
    NONE(entire_transfer_function_table(NULL, f, 16));
    NONE(entire_transfer_function_table(t, NULL, 4 * ENTIRE_TABLE_ENTRIES));
    entire_transfer_function_free(NULL);

    NONE(entire_frame_init(NULL, sizeof frame));
    NONE(entire_session_options_init(NULL, sizeof(entire_session_options)));
    NONE(entire_session_new(NULL, NULL, NULL));
    NONE(entire_session_set_volume(NULL, v));
    NONE(entire_session_set_volume(p, NULL));
    NONE(entire_session_set_time_step(NULL, v));
    NONE(entire_session_set_time_step(p, NULL));
    NONE(entire_session_set_transfer_function(NULL, t));
    NONE(entire_session_set_transfer_function(p, NULL));
    NONE(entire_session_set_limits(NULL, 1, 2));
    NONE(entire_session_set_max_image_sample_distance(NULL, 2, 1));
    NONE(entire_session_set_quality(NULL, 1, 1, 1, 0));
    NONE(entire_session_set_enabled(NULL, 1));
    NONE(entire_session_set_processor_seconds(NULL, 1));
    NONE(entire_session_mark(NULL, 0));
    NONE(entire_session_predict(NULL, &frame, &prediction));
    NONE(entire_session_predict(p, NULL, &prediction));
    NONE(entire_session_predict(p, &frame, NULL));
    NONE(entire_session_plan(NULL, &frame, 1, &plan));
    NONE(entire_session_plan(p, NULL, 1, &plan));
    NONE(entire_session_plan(p, &frame, 1, NULL));
    NONE(entire_session_choose(NULL, &frame, &setting, 1, 1, &n, &plan));
    NONE(entire_session_choose(p, NULL, &setting, 1, 1, &n, &plan));
    NONE(entire_session_choose(p, &frame, NULL, 1, 1, &n, &plan));
    NONE(entire_session_choose(p, &frame, &setting, 1, 1, NULL, &plan));
    NONE(entire_session_choose(p, &frame, &setting, 1, 1, &n, NULL));
    NONE(entire_session_observe(NULL, 1, 1, 0, NULL));
    NONE(entire_session_withdraw(NULL, 1));
    NONE(entire_session_reset(NULL));
    NONE(entire_session_save_state(NULL, &byte, 1, &n));
    NONE(entire_session_save_state(p, NULL, 1, &n));
    NONE(entire_session_save_state(p, &byte, 1, NULL));
    NONE(entire_session_set_timing_source(NULL, "x", "x"));
    NONE(entire_session_set_timing_source(p, NULL, "x"));
    NONE(entire_session_set_timing_source(p, "x", NULL));
    entire_clock clock = 0;
    NONE(entire_session_clocks(NULL, &clock, &clock));
    NONE(entire_session_clocks(p, NULL, &clock));
    NONE(entire_session_clocks(p, &clock, NULL));
    NONE(entire_session_load_state(NULL, &byte, 1));
    NONE(entire_session_load_state(p, NULL, 1));
    NONE(entire_session_record(NULL, NULL, 100));
    NONE(entire_session_calibrate(NULL, &made_model, NULL));
    NONE(entire_session_calibrate(p, NULL, NULL));
    NONE(entire_session_record_picture(NULL, 1, 1, 1, 1, 0));
    float q = 0;
    NONE(entire_session_quality(NULL, &q, &q, &q, &q));
    NONE(entire_session_quality(p, NULL, &q, &q, &q));
    NONE(entire_session_quality(p, &q, NULL, &q, &q));
    NONE(entire_session_quality(p, &q, &q, NULL, &q));
    NONE(entire_session_quality(p, &q, &q, &q, NULL));
    NONE(entire_session_recorded_count(NULL, &n));
    NONE(entire_session_recorded_count(p, NULL));
    NONE(entire_session_set_model(NULL, m));
    NONE(entire_session_set_model(p, NULL));
    NONE(entire_model_save(NULL, "x"));
    NONE(entire_model_save(m, NULL));
    entire_session_free(NULL);

    entire_budget budget = {{0}};
    entire_pass pass = {{0}};
    NONE(entire_budget_begin(NULL, 1));
    NONE(entire_budget_share(NULL, &pass, 1, &q));
    NONE(entire_budget_share(&budget, NULL, 1, &q));
    NONE(entire_budget_share(&budget, &pass, 1, NULL));
    NONE(entire_budget_drew(NULL, &pass, 1, 1));
    NONE(entire_budget_drew(&budget, NULL, 1, 1));
    NONE(entire_budget_end(NULL, 1, 1));

    CHECK(!made_model && !made_volume && !made_tf && !made_session && n == 0 && f[0] == 0);
    entire_session_free(p);
    entire_transfer_function_free(t);
    entire_volume_free(v);
    entire_model_free(m);
    return 0;
}
