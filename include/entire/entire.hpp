// entire.hpp - C++17 over entire.h and advanced.h: owning types, views, and results that must be tested. Header only.
//
// SPDX-License-Identifier: MIT OR Apache-2.0
//
// Every call that can fail returns entire::result<T> or entire::plain_result<T>. Test it (`if (r)`, `r.code()`,
// `r.message()`), or take the value: `r.value()` throws entire::error if the result is a failure. If
// ENTIRE_NO_EXCEPTIONS is defined before the include, or exceptions are off in the compiler, `value()` prints the
// message and ends the program instead. The top of entire.h describes threads, units and ownership. This header
// allocates memory for values in a result<T> and for error texts; a plain_result<T> of a call that succeeded allocates
// none.
#ifndef ENTIRE_ENTIRE_HPP
#define ENTIRE_ENTIRE_HPP

#include <entire/advanced.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <new>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#if !defined(ENTIRE_NO_EXCEPTIONS) && !defined(__cpp_exceptions) && !defined(_CPPUNWIND)
#define ENTIRE_NO_EXCEPTIONS
#endif
#ifndef ENTIRE_NO_EXCEPTIONS
#include <stdexcept>
#endif

namespace entire {

static_assert(ENTIRE_ABI_VERSION == 1,
              "entire.hpp and entire.h are of different versions: install the package again");

#ifndef ENTIRE_NO_EXCEPTIONS
// The exception of result<T>::value().
class error : public std::runtime_error {
public:
    error(entire_result code, const std::string &message) : std::runtime_error(message), code_(code) {}
    entire_result code() const noexcept { return code_; }

private:
    entire_result code_;
};
#endif

// A failure: its code and its text.
struct failure {
    entire_result code;
    std::string message;

    // The failure of the calling thread's last call.
    static failure last(entire_result code) { return {code, entire_last_error()}; }
};

namespace detail {
struct nothing {};

[[noreturn]] inline void refuse(entire_result code, const std::string &message) {
#ifndef ENTIRE_NO_EXCEPTIONS
    throw error(code, message);
#else
    std::fprintf(stderr, "entire: %s: %s\n", entire_result_name(code), message.c_str());
    std::abort();
#endif
}
} // namespace detail

// A value, or the failure of a call.
template <class T> class [[nodiscard]] result {
public:
    result(T value) : value_(std::make_unique<T>(std::move(value))) {}
    result(failure why) : failure_(std::move(why)) {}

    explicit operator bool() const noexcept { return value_ != nullptr; }
    // ENTIRE_OK, or the failure's code.
    entire_result code() const noexcept { return failure_.code; }
    // The failure's text; empty on success.
    const std::string &message() const noexcept { return failure_.message; }

    T &value() & {
        check();
        return *value_;
    }
    const T &value() const & {
        check();
        return *value_;
    }
    T value() && {
        check();
        return std::move(*value_);
    }

private:
    void check() const {
        if (!value_) detail::refuse(failure_.code, failure_.message);
    }

    std::unique_ptr<T> value_;
    failure failure_{ENTIRE_OK, {}};
};

// The result of a call without a value, or with plain data, which is stored in place: success allocates nothing.
template <class T> class [[nodiscard]] plain_result {
    static_assert(std::is_trivially_copyable_v<T>, "use result<T> for a type that is not trivially copyable");

public:
    plain_result(T value) : value_(value), code_(ENTIRE_OK) {}
    plain_result(failure why) : value_(), code_(why.code), message_(std::move(why.message)) {}

    explicit operator bool() const noexcept { return code_ == ENTIRE_OK; }
    entire_result code() const noexcept { return code_; }
    const std::string &message() const noexcept { return message_; }

    T value() const {
        if (code_ != ENTIRE_OK) detail::refuse(code_, message_);
        return value_;
    }

private:
    T value_;
    entire_result code_;
    std::string message_;
};

// The result of a call without a value.
using status = plain_result<detail::nothing>;

// A view of elements that another object owns, like std::span of C++20, from which it can be made.
template <class T> class span {
public:
    constexpr span() noexcept = default;
    constexpr span(T *data, std::size_t size) noexcept : data_(data), size_(size) {}
    template <std::size_t N> constexpr span(T (&array)[N]) noexcept : data_(array), size_(N) {}
    template <class Container,
              class = std::enable_if_t<std::is_convertible_v<decltype(std::declval<Container &>().data()), T *>>>
    constexpr span(Container &&container) noexcept : data_(container.data()), size_(container.size()) {}

    constexpr T *data() const noexcept { return data_; }
    constexpr std::size_t size() const noexcept { return size_; }
    constexpr bool empty() const noexcept { return size_ == 0; }
    constexpr T *begin() const noexcept { return data_; }
    constexpr T *end() const noexcept { return data_ + size_; }
    constexpr T &operator[](std::size_t i) const { return data_[i]; }

private:
    T *data_ = nullptr;
    std::size_t size_ = 0;
};

namespace detail {
template <class T> T sized() {
    T value{};
    value.struct_size = sizeof(T);
    return value;
}

inline status done(entire_result code) {
    if (code != ENTIRE_OK) return failure::last(code);
    return nothing{};
}

// The failure of a call with a model that was moved from. Needed where the C function takes NULL for no model.
inline failure no_model() { return {ENTIRE_NULL_ARGUMENT, "the model was moved from; pass the model that owns it"}; }

template <class Handle, void (*Free)(Handle *)> struct deleter {
    void operator()(Handle *handle) const noexcept { Free(handle); }
};
template <class Handle, void (*Free)(Handle *)> using owned = std::unique_ptr<Handle, deleter<Handle, Free>>;

template <class T> struct scalar_type;
template <> struct scalar_type<std::uint8_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_U8> {};
template <> struct scalar_type<std::int8_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_I8> {};
template <> struct scalar_type<std::uint16_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_U16> {};
template <> struct scalar_type<std::int16_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_I16> {};
template <> struct scalar_type<std::uint32_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_U32> {};
template <> struct scalar_type<std::int32_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_I32> {};
template <> struct scalar_type<std::uint64_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_U64> {};
template <> struct scalar_type<std::int64_t> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_I64> {};
template <> struct scalar_type<float> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_F32> {};
template <> struct scalar_type<double> : std::integral_constant<entire_scalar_type, ENTIRE_SCALAR_F64> {};
} // namespace detail

// A frame, already filled with the defaults.
struct frame : entire_frame {
    frame(std::uint32_t image_width, std::uint32_t image_height) : entire_frame() {
        entire_frame_init(this, sizeof(entire_frame));
        width = image_width;
        height = image_height;
    }

    // Parallel projection. `scale` is half of the visible height: in world units after look, in bounding-sphere radii
    // after orbit.
    frame &parallel(float scale) {
        projection = ENTIRE_PROJECTION_PARALLEL;
        parallel_scale = scale;
        return *this;
    }

    // Perspective projection with a vertical field of view in degrees.
    frame &perspective(float degrees) {
        projection = ENTIRE_PROJECTION_PERSPECTIVE;
        fov_y = degrees;
        return *this;
    }

    // Arcball camera: rotation in degrees about x and y, distance in bounding-sphere radii.
    frame &orbit(float rx, float ry, float dz) {
        camera = ENTIRE_CAMERA_ARCBALL;
        arcball[0] = rx;
        arcball[1] = ry;
        arcball[2] = dz;
        return *this;
    }

    // Camera of a world-to-eye matrix, column-major, and the world position of the volume's center.
    frame &look(const float (&world_to_eye)[16], float x, float y, float z) {
        camera = ENTIRE_CAMERA_VIEW;
        for (int i = 0; i < 16; ++i) view[i] = world_to_eye[i];
        volume_center[0] = x;
        volume_center[1] = y;
        volume_center[2] = z;
        return *this;
    }
};

// A volume of voxels, already filled with the defaults.
struct volume_desc : entire_volume_desc {
    volume_desc() : entire_volume_desc() { entire_volume_desc_init(this, sizeof(entire_volume_desc)); }

    template <class T> volume_desc(span<const T> elements, std::size_t x, std::size_t y, std::size_t z) : volume_desc() {
        scalar_type = detail::scalar_type<T>::value;
        voxels = elements.data();
        voxel_count = elements.size();
        dims[0] = x;
        dims[1] = y;
        dims[2] = z;
    }
};

struct brick_desc : entire_brick_desc {
    brick_desc() : entire_brick_desc() { entire_brick_desc_init(this, sizeof(entire_brick_desc)); }
};

struct session_options : entire_session_options {
    session_options() : entire_session_options() {
        entire_session_options_init(this, sizeof(entire_session_options));
    }
};

class volume {
public:
    static result<volume> create(const entire_volume_desc &desc) {
        entire_volume *handle = nullptr;
        if (auto code = entire_volume_new(&desc, &handle)) return failure::last(code);
        return volume(handle);
    }
    static result<volume> from_bricks(const entire_brick_desc &desc) {
        entire_volume *handle = nullptr;
        if (auto code = entire_volume_from_bricks(&desc, &handle)) return failure::last(code);
        return volume(handle);
    }

    status set_features(span<const float> features) {
        return detail::done(entire_volume_set_features(get(), features.data(), features.size()));
    }
    // Sets the next time step: other voxels, or the borrowed ones after they were written to. Then call set_time_step
    // of each session.
    status update(const entire_volume_desc &desc) { return detail::done(entire_volume_update(get(), &desc)); }
    // Sets the next time step if only the voxels of a box changed: `size` voxels along x, y, z from voxel `first` on.
    status update(const entire_volume_desc &desc, const std::size_t (&first)[3], const std::size_t (&size)[3]) {
        return detail::done(entire_volume_update_box(get(), &desc, first, size));
    }
    plain_result<entire_volume_info> info() const {
        auto out = detail::sized<entire_volume_info>();
        if (auto code = entire_volume_describe(get(), &out)) return failure::last(code);
        return out;
    }
    entire_volume *get() const noexcept { return handle_.get(); }

private:
    explicit volume(entire_volume *handle) : handle_(handle) {}
    detail::owned<entire_volume, entire_volume_free> handle_;
};

class transfer_function {
public:
    static result<transfer_function> from_lobes(span<const entire_gaussian_lobe> lobes) {
        entire_transfer_function *handle = nullptr;
        if (auto code = entire_transfer_function_from_lobes(lobes.data(), lobes.size(), &handle))
            return failure::last(code);
        return transfer_function(handle);
    }
    // Nodes as in VTK and ParaView, over the scalar range `low` to `high`.
    static result<transfer_function> from_nodes(span<const entire_opacity_node> opacity,
                                                span<const entire_color_node> color, double low, double high,
                                                bool clamping = true) {
        entire_transfer_function *handle = nullptr;
        if (auto code = entire_transfer_function_from_nodes(opacity.data(), opacity.size(), color.data(), color.size(),
                                                            low, high, clamping, &handle))
            return failure::last(code);
        return transfer_function(handle);
    }
    // Makes a transfer function from a table; each entry has four floats: red, green, blue, opacity.
    static result<transfer_function> from_table(span<const float> rgba) {
        if (rgba.size() % 4 != 0)
            return failure{ENTIRE_SIZE_MISMATCH, "rgba holds " + std::to_string(rgba.size()) +
                                                     " floats; it must hold four per entry"};
        entire_transfer_function *handle = nullptr;
        if (auto code = entire_transfer_function_from_table(rgba.data(), rgba.size() / 4, &handle))
            return failure::last(code);
        return transfer_function(handle);
    }

    status set_unit_distance(float distance, entire_unit unit) {
        return detail::done(entire_transfer_function_set_unit_distance(get(), distance, unit));
    }
    result<std::vector<float>> table() const {
        std::vector<float> rgba(4 * ENTIRE_TABLE_ENTRIES);
        if (auto code = entire_transfer_function_table(get(), rgba.data(), rgba.size())) return failure::last(code);
        return rgba;
    }
    entire_transfer_function *get() const noexcept { return handle_.get(); }

private:
    explicit transfer_function(entire_transfer_function *handle) : handle_(handle) {}
    detail::owned<entire_transfer_function, entire_transfer_function_free> handle_;
};

class model {
public:
    static result<model> open(const char *path) {
        entire_model *handle = nullptr;
        if (auto code = entire_model_open(path, &handle)) return failure::last(code);
        return model(handle);
    }
    static result<model> open(const std::string &path) { return open(path.c_str()); }
    // The model that `entire calibrate` made for this machine.
    static result<model> open_machine(entire_shading shading) {
        entire_model *handle = nullptr;
        if (auto code = entire_model_open_machine(shading, &handle)) return failure::last(code);
        return model(handle);
    }
    static result<model> from_bytes(span<const std::uint8_t> bytes) {
        entire_model *handle = nullptr;
        if (auto code = entire_model_from_bytes(bytes.data(), bytes.size(), &handle)) return failure::last(code);
        return model(handle);
    }

    plain_result<entire_model_info> info() const {
        auto out = detail::sized<entire_model_info>();
        if (auto code = entire_model_describe(get(), &out)) return failure::last(code);
        return out;
    }
    plain_result<entire_input_group> input(std::size_t index) const {
        auto out = detail::sized<entire_input_group>();
        if (auto code = entire_model_input_group(get(), index, &out)) return failure::last(code);
        return out;
    }
    // NULL if the file does not have the key.
    const char *metadata(const char *key) const noexcept { return entire_model_metadata(get(), key); }
    const char *scene_feature(std::size_t index) const noexcept { return entire_model_scene_feature(get(), index); }

    plain_result<float> predict(span<const float> inputs) const {
        float seconds = 0;
        if (auto code = entire_model_predict(get(), inputs.data(), inputs.size(), &seconds)) return failure::last(code);
        return seconds;
    }
    // Predicts a batch: `inputs` holds one row of inputs per element of `seconds`.
    status predict(span<const float> inputs, span<float> seconds) const {
        const std::size_t columns = seconds.empty() ? 0 : inputs.size() / seconds.size();
        if (columns * seconds.size() != inputs.size())
            return failure{ENTIRE_SIZE_MISMATCH, std::to_string(inputs.size()) + " inputs cannot be divided among " +
                                                     std::to_string(seconds.size()) +
                                                     " frames equally; pass one row of inputs per frame"};
        return detail::done(
            entire_model_predict_batch(get(), inputs.data(), seconds.size(), columns, seconds.data()));
    }
    result<std::vector<float>> encode(const volume &of) const {
        auto about = info();
        if (!about) return failure{about.code(), about.message()};
        std::vector<float> features(about.value().feature_count);
        std::size_t count = 0;
        if (auto code = entire_model_encode(get(), of.get(), features.data(), features.size(), &count))
            return failure::last(code);
        return features;
    }
    status save(const std::string &path) const { return detail::done(entire_model_save(get(), path.c_str())); }
    // Takes ownership of a handle of the C interface.
    static model adopt(entire_model *handle) { return model(handle); }
    entire_model *get() const noexcept { return handle_.get(); }

private:
    explicit model(entire_model *handle) : handle_(handle) {}
    detail::owned<entire_model, entire_model_free> handle_;
};

// The result of entire_session_calibrate.
struct calibration {
    model fitted;
    entire_calibration_report report;
};

// The clock of the times that a session's model predicts, and the clock of the observed times (ENTIRE_CLOCK_*).
struct clocks {
    entire_clock model = ENTIRE_CLOCK_UNSTATED, own = ENTIRE_CLOCK_UNSTATED;
    // True if both are stated and differ: the factor between them is learned from the first frames.
    bool differ() const noexcept {
        return model != own && model != ENTIRE_CLOCK_UNSTATED && own != ENTIRE_CLOCK_UNSTATED;
    }
};

// Quality law of a renderer (entire_session_set_quality); `image_weight` is 0 if none is known.
struct quality {
    float image_weight = 0, step_exponent = 0, image_exponent = 0, ray_share = 0;
};

// The result of entire_session_choose: the index of the chosen setting, and its plan.
struct choice {
    std::size_t index;
    entire_plan plan;
};

class session {
public:
    // Makes a session with a model.
    static result<session> create(const model &with, const entire_session_options &options = session_options()) {
        if (!with.get()) return detail::no_model();
        return make(with.get(), options);
    }
    // Makes a session without a model: an analytic model predicts, which adapts to the observed frames.
    static result<session> untrained(const entire_session_options &options = session_options()) {
        return make(nullptr, options);
    }

    status set_volume(const volume &of) { return detail::done(entire_session_set_volume(get(), of.get())); }
    status set_time_step(const volume &of) { return detail::done(entire_session_set_time_step(get(), of.get())); }
    status set_transfer_function(const transfer_function &to) {
        return detail::done(entire_session_set_transfer_function(get(), to.get()));
    }
    status set_limits(float finest_step, float coarsest_step) {
        return detail::done(entire_session_set_limits(get(), finest_step, coarsest_step));
    }
    status set_max_image_sample_distance(float distance, float step_alone = 1) {
        return detail::done(entire_session_set_max_image_sample_distance(get(), distance, step_alone));
    }
    // Sets the quality law of this renderer; an `image_weight` of 0 removes it.
    status set_quality(float image_weight, float step_exponent, float image_exponent, float ray_share) {
        return detail::done(
            entire_session_set_quality(get(), image_weight, step_exponent, image_exponent, ray_share));
    }
    // The quality law that plans use: the one that was set, else the model's if it is for this renderer, else the
    // built-in one of the renderer that set_timing_source() names.
    plain_result<entire::quality> quality() const {
        entire::quality known;
        if (auto code = entire_session_quality(get(), &known.image_weight, &known.step_exponent, &known.image_exponent,
                &known.ray_share))
            return failure::last(code);
        return known;
    }
    status set_enabled(bool enabled) { return detail::done(entire_session_set_enabled(get(), enabled)); }
    status mark(std::uint32_t changes) { return detail::done(entire_session_mark(get(), changes)); }

    plain_result<entire_prediction> predict(const entire_frame &of) {
        auto out = detail::sized<entire_prediction>();
        if (auto code = entire_session_predict(get(), &of, &out)) return failure::last(code);
        return out;
    }
    plain_result<entire_plan> plan(const entire_frame &of, float target_seconds) {
        auto out = detail::sized<entire_plan>();
        if (auto code = entire_session_plan(get(), &of, target_seconds, &out)) return failure::last(code);
        return out;
    }
    plain_result<choice> choose(const entire_frame &of, span<const entire_setting> settings, float target_seconds) {
        choice out{0, detail::sized<entire_plan>()};
        if (auto code = entire_session_choose(get(), &of, settings.data(), settings.size(), target_seconds, &out.index,
                                                &out.plan))
            return failure::last(code);
        return out;
    }
    status set_processor_seconds(float seconds) {
        return detail::done(entire_session_set_processor_seconds(get(), seconds));
    }
    plain_result<entire_verdict> observe(std::uint64_t plan_id, float seconds, std::uint32_t flags = 0) {
        entire_verdict verdict = ENTIRE_VERDICT_LEARNED;
        if (auto code = entire_session_observe(get(), plan_id, seconds, flags, &verdict)) return failure::last(code);
        return verdict;
    }
    // Withdraws the newest plan if no frame was drawn with it.
    status withdraw(std::uint64_t plan_id) { return detail::done(entire_session_withdraw(get(), plan_id)); }
    status reset() { return detail::done(entire_session_reset(get())); }

    // Records observed frames for calibrate(), which starts from the unit costs of a software renderer or from a model.
    status record(std::size_t frame_count = 1000) {
        return detail::done(entire_session_record(get(), nullptr, frame_count));
    }
    status record(const model &prior, std::size_t frame_count = 1000) {
        if (!prior.get()) return detail::no_model();
        return detail::done(entire_session_record(get(), prior.get(), frame_count));
    }
    plain_result<std::size_t> recorded_count() const {
        std::size_t count = 0;
        if (auto code = entire_session_recorded_count(get(), &count)) return failure::last(code);
        return count;
    }
    // Records the error of a picture against the same view at full quality; see entire_session_record_picture.
    status record_picture(std::uint64_t scene, float step, float image_sample_distance, double seconds, double error) {
        return detail::done(
            entire_session_record_picture(get(), scene, step, image_sample_distance, seconds, error));
    }
    // Fits a model of the renderer to the recorded frames.
    result<calibration> calibrate() const {
        entire_model *made = nullptr;
        auto report = detail::sized<entire_calibration_report>();
        if (auto code = entire_session_calibrate(get(), &made, &report)) return failure::last(code);
        return calibration{model::adopt(made), report};
    }
    status set_model(const model &to) { return detail::done(entire_session_set_model(get(), to.get())); }

    // Names the renderer and the clock of the observed times; saved states are valid only for the same names.
    status set_timing_source(const std::string &renderer, const std::string &clock) {
        return detail::done(entire_session_set_timing_source(get(), renderer.c_str(), clock.c_str()));
    }
    plain_result<entire::clocks> clocks() const {
        entire::clocks found;
        if (auto code = entire_session_clocks(get(), &found.model, &found.own)) return failure::last(code);
        return found;
    }
    result<std::vector<std::uint8_t>> save_state() const {
        std::size_t count = 0;
        if (auto code = entire_session_save_state(get(), nullptr, 0, &count)) return failure::last(code);
        std::vector<std::uint8_t> bytes(count);
        if (auto code = entire_session_save_state(get(), bytes.data(), bytes.size(), &count))
            return failure::last(code);
        return bytes;
    }
    status load_state(span<const std::uint8_t> bytes) {
        return detail::done(entire_session_load_state(get(), bytes.data(), bytes.size()));
    }
    entire_session *get() const noexcept { return handle_.get(); }

private:
    explicit session(entire_session *handle) : handle_(handle) {}
    static result<session> make(const entire_model *with, const entire_session_options &options) {
        entire_session *handle = nullptr;
        if (auto code = entire_session_new(with, &options, &handle)) return failure::last(code);
        return session(handle);
    }
    detail::owned<entire_session, entire_session_free> handle_;
};

// State of one volume in a window's frames, for frame_budget.
struct pass : entire_pass {
    pass() : entire_pass{} {}
};

// Divides the time of a window's frame among the passes that draw volumes in it; see entire_budget.
class frame_budget {
public:
    status begin(std::uint32_t volumes = 0) { return detail::done(entire_budget_begin(&budget_, volumes)); }
    plain_result<float> share(const pass &of, float target) const {
        float seconds = 0;
        if (auto code = entire_budget_share(&budget_, &of, target, &seconds)) return failure::last(code);
        return seconds;
    }
    status drew(pass &of, float seconds, float full_seconds) {
        return detail::done(entire_budget_drew(&budget_, &of, seconds, full_seconds));
    }
    status end(float seconds, bool usual = true) { return detail::done(entire_budget_end(&budget_, seconds, usual)); }

private:
    entire_budget budget_{};
};

} // namespace entire

#endif // ENTIRE_ENTIRE_HPP
