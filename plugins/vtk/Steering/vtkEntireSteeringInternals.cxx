// SPDX-License-Identifier: MIT OR Apache-2.0
// Handlers of the window's and the renderer's events, and sessions of leaves.
#include "vtkEntireSteeringInternals.h"

#include "vtkCommand.h"
#include "vtkRendererCollection.h"
#include "vtkSmartPointer.h"

#include <algorithm>
#include <cctype>
#include <chrono>
#include <cstring>
#include <ctime>
#include <iterator>
#include <map>
#include <mutex>

#if defined(_WIN32)
// Last, since its macros break other headers.
#include "vtkWindows.h"
#endif

namespace
{
// Rays along each side of the finest probe for an analytic model; a network's file states its own number. The number is
// lower than the library's default, since a ray takes almost a microsecond after a frame has evicted the probe's data
// from the caches.
constexpr std::uint32_t PROBE_SIDE = 7;
// Estimated error of the probe, as a share of the frame's time, up to which a plan keeps its first probe of 4 rays
// along each side. This probe is enough except for sparse volumes.
constexpr float PROBE_TOLERANCE = 0.3f;

void Copy(char*& to, const char* text)
{
  if (to && std::strcmp(to, text) == 0)
  {
    return;
  }
  const std::size_t size = std::strlen(text) + 1;
  char* copied = new char[size];
  std::memcpy(copied, text, size);
  delete[] to;
  to = copied;
}

// Name of a clock as in model files; nullptr if unstated.
const char* NameOf(entire_clock clock)
{
  switch (clock)
  {
    case ENTIRE_CLOCK_CPU:
      return "cpu";
    case ENTIRE_CLOCK_WALL:
      return "wall";
    case ENTIRE_CLOCK_DEVICE:
      return "device";
    default:
      return nullptr;
  }
}

// Processor time of the process in seconds, summed over all threads.
double ProcessSeconds()
{
#if defined(_WIN32)
  // On Windows, std::clock() returns wall time.
  FILETIME created{}, exited{}, kernel{}, user{};
  GetProcessTimes(GetCurrentProcess(), &created, &exited, &kernel, &user);
  const auto ticks = [](const FILETIME& time) {
    return (static_cast<std::uint64_t>(time.dwHighDateTime) << 32) | time.dwLowDateTime;
  };
  // A tick takes 100 ns.
  return 1e-7 * static_cast<double>(ticks(kernel) + ticks(user));
#else
  // std::clock() overflows after 36 minutes if std::clock_t has 32 bits.
  timespec now{};
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
#endif
}
}

//------------------------------------------------------------------------------
std::shared_ptr<vtkEntireSteering::vtkInternals::WindowFrame> vtkEntireSteering::vtkInternals::WindowFrame::Of(
  vtkRenderWindow* window, int clock)
{
  if (!window)
  {
    return {};
  }
  // Different threads may draw different windows.
  static std::mutex mutex;
  static std::map<std::pair<vtkRenderWindow*, int>, std::weak_ptr<WindowFrame>> frames;
  const std::lock_guard<std::mutex> lock(mutex);
  for (auto each = frames.begin(); each != frames.end();)
  {
    each = each->second.expired() ? frames.erase(each) : std::next(each);
  }
  std::weak_ptr<WindowFrame>& known = frames[{ window, clock }];
  std::shared_ptr<WindowFrame> frame = known.lock();
  if (!frame || frame->Window != window)
  {
    frame = std::make_shared<WindowFrame>();
    frame->Window = window;
    known = frame;
  }
  return frame;
}

//------------------------------------------------------------------------------
vtkEntireSteering::vtkInternals::~vtkInternals()
{
  ReleaseAll(this->TakeApart());
}

//------------------------------------------------------------------------------
double vtkEntireSteering::vtkInternals::Now() const
{
  if (this->LastClock == PROCESS_CPU)
  {
    return ProcessSeconds();
  }
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

//------------------------------------------------------------------------------
const char* vtkEntireSteering::vtkInternals::ClockName() const
{
  return NameOf(this->Owner->Clock == PROCESS_CPU ? ENTIRE_CLOCK_CPU : ENTIRE_CLOCK_WALL);
}

//------------------------------------------------------------------------------
const char* vtkEntireSteering::vtkInternals::ModelClockName() const
{
  return NameOf(this->ModelClock);
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::ClocksText() const
{
  std::string text = std::string("frames are timed by the ") + this->ClockName() + " clock";
  if (const char* model = this->ModelClockName())
  {
    text += std::string("; the model predicts seconds of the ") + model + " clock";
  }
  return text;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::NoteClocks(const entire::session& session)
{
  const auto found = session.clocks();
  if (!found)
  {
    return;
  }
  const entire::clocks clocks = found.value();
  this->ModelClock = clocks.model;
  std::string text;
  if (clocks.differ())
  {
    const std::string model = NameOf(clocks.model), own = NameOf(clocks.own);
    text = "the model predicts seconds of the " + model + " clock, but frames are timed by the " + own +
      " clock: the model's scale is learned from the first frames; \"entire calibrate --data TABLE --clock " + own +
      "\" makes a model of the " + own + " clock";
    if (text != this->ClocksSaid)
    {
      this->Warn(text);
    }
  }
  this->ClocksSaid = std::move(text);
}

//------------------------------------------------------------------------------
vtkEntireSteering::vtkInternals::Leaves vtkEntireSteering::vtkInternals::TakeApart()
{
  this->Attachment++;
  Leaves leaves;
  leaves.swap(this->Drawing);
  this->LastLeaf.reset();
  if (this->Renderer)
  {
    this->Renderer->RemoveObserver(this->RendererTags[0]);
    this->Renderer->RemoveObserver(this->RendererTags[1]);
  }
  this->ObserveWindow(nullptr);
  this->Renderer = nullptr;
  this->Volume = nullptr;
  this->Warnings.clear();
  this->Said.clear();
  this->ClocksSaid.clear();
  this->RefusedModel.clear();
  this->Model.reset();
  this->ModelClock = ENTIRE_CLOCK_UNSTATED;
  this->Rendering = false;
  this->Present = false;
  return leaves;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::ReleaseAll(const Leaves& leaves)
{
  for (const auto& leaf : leaves)
  {
    leaf->Release();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Report(const char* reason, const char* status)
{
  if (reason)
  {
    Copy(this->Owner->Reason, reason);
  }
  if (status)
  {
    Copy(this->Owner->Status, status);
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::FallBack(const std::string& why)
{
  // Warns of a reason once per attachment, even if the numbers in it change or other mappers of the volume are steered.
  std::string key;
  std::copy_if(why.begin(), why.end(), std::back_inserter(key),
    [](unsigned char c) { return !std::isdigit(c) && c != '.' && c != '-'; });
  if (this->Said.insert(key).second)
  {
    this->Warn("Not steered: " + why);
  }
  this->Report("fallback", why.c_str());
  this->Owner->PredictedTime = vtkEntire::NOT_KNOWN;
  this->Owner->SampleDistance = this->Owner->ImageSampleDistance = vtkEntire::NOT_KNOWN;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::SayWarnings()
{
  if (this->Warnings.empty())
  {
    return;
  }
  const vtkEntire::Busy::Elsewhere elsewhere(this->Busy);
  std::vector<std::string> warnings;
  warnings.swap(this->Warnings);
  for (const std::string& text : warnings)
  {
    vtkWarningWithObjectMacro(this->Owner, << text);
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Observe(vtkRenderer* renderer)
{
  this->Renderer = renderer;
  // The priority makes this observer run before others of StartEvent, so that their time counts as part of the frame.
  this->RendererTags[0] =
    renderer->AddObserver(vtkCommand::StartEvent, this, &vtkInternals::RendererStart, 1.0f);
  this->RendererTags[1] = renderer->AddObserver(vtkCommand::EndEvent, this, &vtkInternals::RendererEnd);
  this->ObserveWindow(renderer->GetRenderWindow());
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Share(vtkRenderWindow* window)
{
  if (this->Shared)
  {
    std::vector<vtkInternals*>& all = this->Shared->Steerings;
    all.erase(std::remove(all.begin(), all.end(), this), all.end());
  }
  this->Shared = WindowFrame::Of(window, this->LastClock);
  if (this->Shared)
  {
    this->Shared->Steerings.push_back(this);
  }
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::vtkInternals::IsPicking(vtkRenderWindow* window)
{
  vtkRendererCollection* const renderers = window ? window->GetRenderers() : nullptr;
  if (!renderers)
  {
    return false;
  }
  vtkCollectionSimpleIterator at;
  renderers->InitTraversal(at);
  while (vtkRenderer* const renderer = renderers->GetNextRenderer(at))
  {
    if (renderer->GetSelector())
    {
      return true;
    }
  }
  return false;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::ObserveWindow(vtkRenderWindow* window)
{
  if (this->Window == window && window)
  {
    return;
  }
  if (this->Window)
  {
    this->Window->RemoveObserver(this->WindowTags[0]);
    this->Window->RemoveObserver(this->WindowTags[1]);
  }
  if (this->InFrame && this->Shared)
  {
    // Lets the window's other steerings begin a new frame.
    this->Shared->Drawing = false;
  }
  this->InFrame = false;
  this->Window = window;
  this->Share(window);
  if (window)
  {
    this->WindowTags[0] =
      window->AddObserver(vtkCommand::StartEvent, this, &vtkInternals::WindowStart, 1.0f);
    this->WindowTags[1] = window->AddObserver(vtkCommand::EndEvent, this, &vtkInternals::WindowEnd);
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::FindMappers()
{
  // Fast path for a mapper that is not inside another.
  if (this->Volume && this->Drawing.size() == 1 && !this->Drawing[0]->Outer &&
    this->Drawing[0]->Mapper && this->Drawing[0]->Mapper.GetPointer() == this->Volume->GetMapper())
  {
    return;
  }
  std::vector<vtkEntire::LeafMapper> found;
  if (this->Volume)
  {
    vtkEntire::FindLeafMappers(this->Volume->GetMapper(), found);
  }
  Leaves kept;
  for (const vtkEntire::LeafMapper& each : found)
  {
    const auto is = [&](const std::shared_ptr<Leaf>& leaf) {
      return leaf && leaf->Mapper.GetPointer() == each.Mapper;
    };
    const auto known = std::find_if(this->Drawing.begin(), this->Drawing.end(), is);
    if (known != this->Drawing.end())
    {
      kept.push_back(std::move(*known));
      this->Drawing.erase(known);
    }
    else
    {
      kept.push_back(std::make_shared<Leaf>(this, each));
    }
  }
  // A mapper of the same kind takes over what was learned with the mapper that it replaces. A multi-block mapper replaces
  // its inner mappers whenever its input changes.
  for (const auto& leaf : kept)
  {
    for (const auto& gone : this->Drawing)
    {
      if (!leaf->Session && gone && gone->Session && gone->Gpu == leaf->Gpu && leaf->Mapper)
      {
        leaf->Session = std::move(gone->Session);
        leaf->RefusedState = gone->RefusedState;
        // Forgets what was learned if the new mapper's class differs.
        static_cast<void>(leaf->Session->set_timing_source(leaf->Mapper->GetClassName(), this->ClockName()));
        if (this->LastLeaf.lock() == gone)
        {
          this->LastLeaf = leaf;
        }
      }
    }
  }
  // Releases the leaves whose mappers are not found. Last, since this may invoke observers.
  kept.swap(this->Drawing);
  ReleaseAll(kept);
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::ForEach(void (Leaf::*handle)())
{
  if (this->Drawing.size() == 1)
  {
    // The usual case, without the allocation of a copied list.
    const std::shared_ptr<Leaf> leaf = this->Drawing[0];
    (leaf.get()->*handle)();
    return;
  }
  const Leaves leaves = this->Drawing;
  for (const auto& leaf : leaves)
  {
    (leaf.get()->*handle)();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::RendererStart()
{
  const vtkSmartPointer<vtkEntireSteering> owner(this->Owner);
  const vtkSmartPointer<vtkRenderer> renderer(this->Renderer);
  const vtkEntire::Busy::Handling handling(this->Busy);
  const std::size_t attachment = this->Attachment;
  if (!renderer || IsPicking(renderer->GetRenderWindow()))
  {
    return;
  }
  this->Rendering = true;
  this->ObserveWindow(renderer->GetRenderWindow());
  // A renderer without a camera creates one here and invokes an event.
  renderer->GetActiveCamera();
  if (this->Attachment != attachment)
  {
    return;
  }
  this->FindMappers();
  if (this->Attachment != attachment)
  {
    return;
  }
  this->Present = vtkEntire::IsDrawnBy(renderer, this->Volume);
  if (!this->Present)
  {
    this->Report(nullptr, "the volume is not among the props of the renderer that Attach() was given");
    return;
  }
  // A leaf that is the volume's own mapper needs no check. Without leaves, the mapper may be of a class that cannot be
  // steered. A smart mapper may have been set to another render mode.
  vtkAbstractVolumeMapper* const mapper = this->Volume->GetMapper();
  if (mapper && (this->Drawing.empty() || this->Drawing[0]->Outer))
  {
    const std::string refusal = vtkEntire::Refusal(mapper);
    if (!refusal.empty())
    {
      this->FallBack(refusal);
      return;
    }
  }
  this->ForEach(&Leaf::RendererStart);
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::RendererEnd()
{
  const vtkSmartPointer<vtkEntireSteering> owner(this->Owner);
  const vtkEntire::Busy::Handling handling(this->Busy);
  this->Rendering = false;
  this->ForEach(&Leaf::RendererEnd);
  if (!this->InFrame)
  {
    this->SayWarnings();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::WindowStart()
{
  this->InFrame = this->Shared && !IsPicking(this->Window);
  if (!this->InFrame)
  {
    return;
  }
  this->Busy.Begin();
  const vtkEntire::Busy::Handling handling(this->Busy);
  this->MapperSeconds = this->PredictedSeconds = 0;
  this->Drawn = 0;
  if (this->LastClock != this->Owner->Clock)
  {
    this->LastClock = this->Owner->Clock;
    this->Share(this->Window);
    for (const auto& leaf : this->Drawing)
    {
      leaf->Forget();
    }
  }
  // The first steering of this window begins the frame.
  WindowFrame& frame = *this->Shared;
  if (!frame.Drawing)
  {
    frame.Drawing = frame.Usual = true;
    std::size_t volumes = 0;
    for (const vtkInternals* each : frame.Steerings)
    {
      if (!each->Volume || !each->Volume->GetVisibility())
      {
        continue;
      }
      // Of the mappers inside a smart mapper, one draws.
      const vtkSmartVolumeMapper* before = nullptr;
      for (const auto& leaf : each->Drawing)
      {
        const vtkSmartVolumeMapper* const outer = leaf->Outer;
        volumes += !outer || outer != before;
        before = outer;
      }
    }
    static_cast<void>(frame.Budget.begin(static_cast<std::uint32_t>(volumes)));
    frame.Start = this->Now();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::WindowEnd()
{
  const vtkSmartPointer<vtkEntireSteering> owner(this->Owner);
  const vtkEntire::Busy::Handling handling(this->Busy);
  const std::size_t attachment = this->Attachment;
  if (!this->InFrame)
  {
    return;
  }
  const std::shared_ptr<WindowFrame> frame = this->Shared;
  const double seconds = this->Now() - frame->Start;
  this->InFrame = false;
  if (frame->Drawing)
  {
    frame->Drawing = false;
    static_cast<void>(frame->Budget.end(static_cast<float>(seconds), frame->Usual));
  }
  // A multi-block mapper creates its inner mappers while it draws; they are steered from the next frame on.
  this->FindMappers();
  if (this->Attachment != attachment)
  {
    return;
  }
  const bool drawn = this->Drawn > 0;
  if (drawn)
  {
    owner->FrameTime = seconds;
    owner->MeasuredTime = this->MapperSeconds;
    owner->PredictedTime = this->PredictedSeconds;
    owner->ObserverTime = this->Busy.Seconds();
  }
  this->SayWarnings();
  if (drawn && this->Attachment == attachment)
  {
    const vtkEntire::Busy::Elsewhere elsewhere(this->Busy);
    owner->InvokeEvent(FrameEvent);
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::MatchOwner()
{
  const char* const name = this->Owner->ModelFileName ? this->Owner->ModelFileName : "";
  if (this->ModelName != name || this->Tolerance != this->Owner->Tolerance ||
    this->MissRate != this->Owner->MissRate || this->IgnoreLoad != this->Owner->IgnoreLoad)
  {
    for (const auto& each : this->Drawing)
    {
      each->Forget();
    }
    if (this->ModelName != name)
    {
      this->Model.reset();
      this->RefusedModel.clear();
      this->ClocksSaid.clear();
      this->ModelClock = ENTIRE_CLOCK_UNSTATED;
    }
    this->ModelName = name;
    this->Tolerance = this->Owner->Tolerance;
    this->MissRate = this->Owner->MissRate;
    this->IgnoreLoad = this->Owner->IgnoreLoad;
  }
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::NewSession(
  const Leaf& leaf, std::optional<entire::session>& session)
{
  this->MatchOwner();
  if (!this->Model && !this->ModelName.empty())
  {
    if (!this->RefusedModel.empty())
    {
      return this->RefusedModel;
    }
    auto opened = entire::model::open(this->ModelName);
    if (!opened)
    {
      // A file that is missing, or too large for the free memory, is tried again in the next frame.
      if (opened.code() != ENTIRE_IO && opened.code() != ENTIRE_OUT_OF_MEMORY)
      {
        this->RefusedModel = opened.message();
      }
      return opened.message();
    }
    this->Model.emplace(std::move(opened.value()));
  }
  entire::session_options options;
  options.tolerance = static_cast<float>(this->Tolerance);
  options.miss_rate = static_cast<float>(this->MissRate);
  options.ignore_load = this->IgnoreLoad;
  options.probe_side = PROBE_SIDE;
  options.probe_tolerance = PROBE_TOLERANCE;
  auto made =
    this->Model ? entire::session::create(*this->Model, options) : entire::session::untrained(options);
  if (!made)
  {
    return made.message();
  }
  auto named =
    made.value().set_timing_source(leaf.Mapper ? leaf.Mapper->GetClassName() : "", this->ClockName());
  if (!named)
  {
    return named.message();
  }
  session.emplace(std::move(made.value()));
  return {};
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::MakeSession(Leaf& leaf)
{
  this->MatchOwner();
  if (leaf.Session)
  {
    return {};
  }
  std::optional<entire::session> made;
  const std::string failure = this->NewSession(leaf, made);
  if (!failure.empty())
  {
    return failure;
  }
  if (!this->State.empty())
  {
    auto loaded = made->load_state(this->State);
    if (!loaded && !leaf.RefusedState)
    {
      // This mapper is steered without the state, which is kept for the other mappers.
      this->Warn("LoadState(): " + loaded.message());
    }
    leaf.RefusedState = !loaded;
  }
  this->NoteClocks(*made);
  leaf.Session = std::make_shared<entire::session>(std::move(*made));
  return {};
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::Try(const std::vector<std::uint8_t>& state)
{
  if (this->Drawing.empty())
  {
    auto any = entire::session::untrained();
    if (!any)
    {
      return any.message();
    }
    auto loaded = any.value().load_state(state);
    return loaded || loaded.code() == ENTIRE_UNSUPPORTED ? std::string() : loaded.message();
  }
  // If no leaf accepts the state, returns the error of the last drawn leaf, whose state SaveState() would write.
  std::string failure;
  const Leaves leaves = this->Drawing;
  const std::shared_ptr<Leaf> last = this->LastLeaf.lock();
  for (const auto& leaf : leaves)
  {
    std::optional<entire::session> trial;
    std::string why = this->NewSession(*leaf, trial);
    if (why.empty())
    {
      auto loaded = trial->load_state(state);
      if (loaded)
      {
        return {};
      }
      why = loaded.message();
    }
    if (failure.empty() || leaf == last)
    {
      failure = std::move(why);
    }
  }
  return failure;
}
