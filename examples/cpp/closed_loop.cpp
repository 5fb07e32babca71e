// A closed loop around a real, if tiny, ray caster on the CPU: every frame is planned, drawn with the plan's step, timed,
// and observed. After half of the frames, the transfer function changes from fog to a surface.
//
//   closed_loop [TARGET_MILLISECONDS [FRAMES]]
#include <entire/entire.hpp>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

namespace {
constexpr int N = 64, SIDE = 128;

// Returns the voxels of a ball whose density falls from 1 at its center to 0 at its surface.
std::vector<float> make_voxels() {
    std::vector<float> v(N * N * N);
    for (int i = 0; i < N * N * N; ++i) {
        const float x = float(i % N) - 31.5f, y = float(i / N % N) - 31.5f, z = float(i / N / N) - 31.5f;
        v[i] = std::fmax(0.0f, 1.0f - std::sqrt(x * x + y * y + z * z) / 32.0f);
    }
    return v;
}

// Returns the mean opacity of parallel rays along z, rotated about y by `degrees`. Opaque rays end early.
float draw(const std::vector<float> &voxels, const std::vector<float> &rgba, float degrees, float step) {
    const float c = std::cos(degrees * 0.0174533f), s = std::sin(degrees * 0.0174533f);
    float sum = 0;
    for (int py = 0; py < SIDE; ++py)
        for (int px = 0; px < SIDE; ++px) {
            const float u = (px + 0.5f) * N / SIDE - N / 2, v = (py + 0.5f) * N / SIDE;
            float alpha = 0;
            for (float t = -0.87f * N; t < 0.87f * N && alpha < 0.99f; t += step) {
                const float x = c * u + s * t + N / 2, z = c * t - s * u + N / 2;
                if (x < 0 || z < 0 || x >= N || z >= N) continue;
                const float value = voxels[(int(z) * N + int(v)) * N + int(x)];
                const float opacity = rgba[4 * int(value * 255) + 3];
                alpha += (1 - alpha) * (1 - std::pow(1 - opacity, step));
            }
            sum += alpha;
        }
    return sum / (SIDE * SIDE);
}
} // namespace

int main(int argc, char **argv) try {
    const float target = argc > 1 ? std::strtof(argv[1], nullptr) * 1e-3f : 0.02f;
    const int frames = argc > 2 ? std::atoi(argv[2]) : 60;
    const auto voxels = make_voxels();

    auto session = entire::session::untrained().value();
    const entire::volume_desc desc(entire::span<const float>(voxels), N, N, N);
    session.set_volume(entire::volume::create(desc).value()).value();
    std::vector<float> rgba;
    auto set_lobe = [&](entire_gaussian_lobe lobe) {
        auto tf = entire::transfer_function::from_lobes({&lobe, 1}).value();
        rgba = tf.table().value();
        session.set_transfer_function(tf).value();
    };
    set_lobe({0.5f, 0.3f, 0.01f});

    entire::frame frame(SIDE, SIDE);
    frame.skipping = ENTIRE_SKIPPING_NONE;
    for (int i = 0; i < frames; ++i) {
        if (i == frames / 2) set_lobe({0.6f, 0.005f, 0.8f});
        frame.orbit(0, 4.0f * i, 3);
        const entire_plan plan = session.plan(frame, target).value();
        const auto start = std::chrono::steady_clock::now();
        const float opacity = draw(voxels, rgba, 4.0f * i, plan.step);
        const std::chrono::duration<float> took = std::chrono::steady_clock::now() - start;
        session.observe(plan.id, took.count()).value();
        std::printf("frame %2d  step %5.2f  predicted %7.2f ms  took %7.2f ms  mean opacity %.2f\n", i, plan.step,
                    1e3f * plan.seconds, 1e3f * took.count(), opacity);
    }
    return 0;
} catch (const entire::error &e) {
    return std::fprintf(stderr, "%s: %s\n", entire_result_name(e.code()), e.what()), 1;
}
