// entire.hpp: ownership, results, views; built with exceptions and without them, as C++17 and as C++20.
#include <entire/entire.hpp>

#include <array>
#include <cmath>
#include <cstring>
#if defined(__cpp_lib_span) || __cplusplus >= 202002L
#include <span>
#endif

#define CHECK(condition)                                                                                              \
    do {                                                                                                              \
        if (!(condition)) {                                                                                           \
            std::fprintf(stderr, "%s:%d: %s is false; last error: %s\n", __FILE__, __LINE__, #condition,              \
                         entire_last_error());                                                                        \
            std::exit(1);                                                                                             \
        }                                                                                                             \
    } while (0)

static_assert(!std::is_copy_constructible_v<entire::model> && std::is_nothrow_move_constructible_v<entire::model>);
static_assert(!std::is_copy_constructible_v<entire::volume> && std::is_nothrow_move_constructible_v<entire::volume>);
static_assert(std::is_nothrow_move_constructible_v<entire::session>);
static_assert(std::is_nothrow_move_constructible_v<entire::transfer_function>);

static entire::volume make_volume() {
    std::vector<std::uint16_t> voxels(5 * 7 * 11);
    for (std::size_t i = 0; i < voxels.size(); ++i) voxels[i] = std::uint16_t(i * 37 % 4096);
    entire::volume_desc desc(entire::span<const std::uint16_t>(voxels), 5, 7, 11);
    desc.spacing[2] = 3;
    return entire::volume::create(desc).value();
}

static void failures() {
    auto missing = entire::model::open("/no/such/file");
    CHECK(!missing && missing.code() == ENTIRE_IO && missing.message().find("/no/such/file") == 0);
    const auto junk = std::array<std::uint8_t, 5>{1, 2, 3, 4, 5};
    CHECK(entire::model::from_bytes(junk).code() == ENTIRE_INVALID_MODEL);
    auto session = entire::session::untrained().value();
    CHECK(session.plan(entire::frame(8, 8), 0.01f).code() == ENTIRE_NOT_READY);
    CHECK(!session.set_limits(3, 2) && session.set_limits(2, 3));
#ifndef ENTIRE_NO_EXCEPTIONS
    bool caught = false;
    try {
        (void)entire::model::open("/no/such/file").value();
    } catch (const entire::error &e) {
        caught = e.code() == ENTIRE_IO && std::strstr(e.what(), "/no/such/file");
    }
    CHECK(caught);
    caught = false;
    try {
        (void)session.plan(entire::frame(8, 8), 0.01f).value();
    } catch (const std::runtime_error &) {
        caught = true;
    }
    CHECK(caught);
#endif
}

int main(int argc, char **argv) {
    CHECK(argc == 2);
    failures();
    auto opened = entire::model::open(std::string(argv[1]));
    CHECK(opened && opened.code() == ENTIRE_OK && opened.message().empty());
    entire::model model = std::move(opened).value();
    const auto info = model.info().value();
    CHECK(info.input_count == 11 && std::strcmp(model.input(1).value().name, "camera") == 0);
    CHECK(!model.input(99) && model.metadata("nothing") == nullptr && model.scene_feature(0) == nullptr);

    entire::volume volume = make_volume();
    CHECK(volume.info().value().dims[2] == 11);
    const auto features = model.encode(volume).value();
    CHECK(features.size() == 2);

    std::vector<float> inputs = {features[0], features[1], 0, 0, 3, 256, 256, 0.5f, 0.01f, 0.5f, 1};
    const float alone = model.predict(inputs).value();
    CHECK(alone > 0);
    inputs.insert(inputs.end(), inputs.begin(), inputs.end());
    std::array<float, 2> both{};
    CHECK(model.predict(inputs, both));
    CHECK(std::fabs(both[0] - alone) <= 1e-5f * alone && both[0] == both[1]);
    CHECK(model.predict(entire::span<const float>(inputs.data(), 3)).code() == ENTIRE_SIZE_MISMATCH);
    std::vector<float> uneven = inputs;
    uneven.push_back(1);
    CHECK(model.predict(uneven, both).code() == ENTIRE_SIZE_MISMATCH);
#if __cplusplus >= 202002L
    CHECK(model.predict(std::span<const float>(inputs).first(11)).value() == alone);
#endif

    auto session = entire::session::create(model).value();
    session.set_volume(volume).value();
    const entire_gaussian_lobe lobe = {0.5f, 0.01f, 0.5f};
    auto lobes = entire::transfer_function::from_lobes({&lobe, 1}).value();
    CHECK(lobes.table().value().size() == 1024 && lobes.set_unit_distance(2, ENTIRE_UNIT_WORLD));
    CHECK(session.set_transfer_function(lobes));
    std::vector<std::uint16_t> next(5 * 7 * 11, 30);
    entire::volume_desc step(entire::span<const std::uint16_t>(next), 5, 7, 11);
    CHECK(volume.update(step).code() == ENTIRE_INVALID_ARGUMENT);
    step.spacing[2] = 3;
    CHECK(volume.update(step) && session.set_time_step(volume));
    next[0] = 4000;
    CHECK(volume.update(step, {0, 0, 0}, {1, 1, 1}) && session.set_time_step(volume));
    const entire_opacity_node nodes[] = {{0, 0, 0.5, 0}, {4095, 0.8, 0.5, 0.3}};
    const entire_color_node colors[] = {{0, {0, 0, 1}, 0.5, 0}, {4095, {1, 0, 0}, 0.5, 0}};
    CHECK(entire::transfer_function::from_nodes(nodes, colors, 0, 4095));
    CHECK(entire::transfer_function::from_table(lobes.table().value()));
    const float odd[5] = {0.1f, 0.2f, 0.3f, 0.4f, 0.5f};
    CHECK(entire::transfer_function::from_table(entire::span<const float>(odd, 5)).code() == ENTIRE_SIZE_MISMATCH);

    entire::frame frame(64, 64);
    const auto plan = session.plan(frame.orbit(10, 20, 3), 0.02f).value();
    CHECK(plan.id != 0);
    CHECK(session.observe(plan.id, 0.015f));
    CHECK(session.observe(plan.id, 0.015f).code() == ENTIRE_REJECTED_OBSERVATION);
    const float identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -100, 1};
    CHECK(session.predict(frame.look(identity, 0, 0, 0)).value().seconds > 0);
    const std::array<entire_setting, 2> settings = {{{1, 64, 64, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS},
                                                     {2, 64, 64, ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS}}};
    CHECK(session.choose(frame, settings, 1000).value().index == 0);
    const auto state = session.save_state().value();
    CHECK(session.set_timing_source("a mapper", "wall") && !session.load_state(state));
    CHECK(session.clocks().value().own == ENTIRE_CLOCK_WALL && !session.clocks().value().differ());
    CHECK(session.set_timing_source("", "") && !session.set_timing_source(std::string(257, 'x'), ""));
    CHECK(!state.empty() && session.load_state(state) && session.reset() && session.mark(ENTIRE_CHANGE_CAMERA));
    CHECK(session.set_enabled(false) && session.plan(frame, 0.02f).value().reason == ENTIRE_REASON_OFF);

    CHECK(session.calibrate().code() == ENTIRE_NOT_READY && !session.record(3) && session.record(50));
    for (std::uint32_t i = 0; i < 20; ++i) {
        entire::frame drawn(32 + 16 * i, 64);
        const auto one = session.plan(drawn.orbit(10, float(i), 3), 0.02f).value();
        CHECK(session.observe(one.id, 0.001f * float(2 + i)));
    }
    CHECK(session.recorded_count().value() == 20);
    const auto made = session.calibrate();
    CHECK(made && made.value().report.frames == 20 && session.set_model(made.value().fitted));
    CHECK(made.value().fitted.save("/no/such/folder/m.safetensors").code() == ENTIRE_IO);
    CHECK(session.record(made.value().fitted, 8));

    entire::model kept = std::move(model);
    CHECK(entire::session::create(model).code() == ENTIRE_NULL_ARGUMENT && entire::session::create(kept));
    CHECK(session.record(model).code() == ENTIRE_NULL_ARGUMENT && session.recorded_count().value() == 0);
    entire::session moved = std::move(session);
    CHECK(session.get() == nullptr && moved.get() != nullptr);
    CHECK(session.reset().code() == ENTIRE_NULL_ARGUMENT);
    return 0;
}
