// SPDX-License-Identifier: MIT OR Apache-2.0
// Parts of an attached vtkEntireSteering: vtkInternals handles the events of the window and the renderer, Leaf those of
// one mapper that draws.
//
// Observers of any event may call back: detach, attach elsewhere, drop the last reference to the steering.
// A handler of an event therefore holds references to the owner and the leaf, and iterates over copies of lists. After
// each call into VTK that can invoke an event, the handler checks that the attachment has not ended. Warnings are
// raised at the end of the frame.
#ifndef vtkEntireSteeringInternals_h
#define vtkEntireSteeringInternals_h

#include "vtkEntireMapperAccess.h"
#include "vtkEntireSceneReading.h"
#include "vtkEntireSteering.h"

#include "vtkRenderWindow.h"
#include "vtkRenderer.h"
#include "vtkSmartVolumeMapper.h"
#include "vtkVolume.h"
#include "vtkVolumeMapper.h"
#include "vtkWeakPointer.h"

#include <entire/entire.hpp>

#include <array>
#include <chrono>
#include <cstdint>
#include <ctime>
#include <limits>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

namespace vtkEntire
{
constexpr double NOT_KNOWN = std::numeric_limits<double>::quiet_NaN();

// Settings whose change is announced as a change of mode: shading, interpolation, blend mode, gradient opacity; of GPU
// mappers also jittering and scattering.
using ModeKey = std::array<int, 6>;

// Keeps an object alive during a call, as a smart pointer does. A smart pointer that releases an algorithm or a data
// object makes VTK's garbage collector traverse its pipeline, in every frame; this class does so only if another
// reference was released meanwhile.
template <class T>
class Hold
{
public:
  explicit Hold(T* object)
    : Object(object)
  {
    if (object)
    {
      Counting::Add(object);
      this->Count = object->GetReferenceCount();
    }
  }
  ~Hold()
  {
    if (this->Object && this->Object->GetReferenceCount() < this->Count)
    {
      this->Object->UnRegister(nullptr);
    }
    else if (this->Object)
    {
      Counting::Remove(this->Object);
    }
  }
  Hold(const Hold&) = delete;
  void operator=(const Hold&) = delete;

  operator T*() const { return this->Object; }
  T* operator->() const { return this->Object; }

private:
  struct Counting : vtkObjectBase
  {
    static void Add(vtkObjectBase* object) { (object->*&Counting::RegisterInternal)(nullptr, 0); }
    static void Remove(vtkObjectBase* object) { (object->*&Counting::UnRegisterInternal)(nullptr, 0); }
  };

  T* Object;
  int Count = 0;
};

// Measures the wall time of handling a frame's events, excluding calls to VTK and to the application.
class Busy
{
public:
  // While an object of this class exists, an event is being handled, and the time is counted. Handlers may be nested.
  class Handling
  {
  public:
    explicit Handling(Busy& busy)
      : Of(busy)
    {
      if (this->Of.Depth++ == 0)
      {
        this->Of.Since = Time::now();
      }
    }
    ~Handling()
    {
      this->Of.Count();
      this->Of.Depth--;
    }
    Handling(const Handling&) = delete;
    void operator=(const Handling&) = delete;

  private:
    Busy& Of;
  };

  // While an object of this class exists, other code runs, and no time is counted, except in handlers of events that
  // the other code invokes.
  class Elsewhere
  {
  public:
    explicit Elsewhere(Busy& busy)
      : Of(busy)
    {
      this->Of.Count();
      std::swap(this->Depth, this->Of.Depth);
    }
    ~Elsewhere()
    {
      std::swap(this->Depth, this->Of.Depth);
      this->Of.Since = Time::now();
    }
    Elsewhere(const Elsewhere&) = delete;
    void operator=(const Elsewhere&) = delete;

  private:
    Busy& Of;
    int Depth = 0;
  };

  // Seconds counted since Begin().
  double Seconds()
  {
    this->Count();
    return this->Total;
  }
  void Begin() { this->Total = 0; }

private:
  using Time = std::chrono::steady_clock;

  void Count()
  {
    if (this->Depth > 0)
    {
      const auto now = Time::now();
      this->Total += std::chrono::duration<double>(now - this->Since).count();
      this->Since = now;
    }
  }

  double Total = 0;
  int Depth = 0;
  Time::time_point Since;
};
}

class vtkEntireSteering::vtkInternals
{
public:
  // A window's frame, shared by all steerings in the window with the same clock.
  struct WindowFrame
  {
    // Returns the frame that the steerings of this window with this clock share; null if `window` is null.
    static std::shared_ptr<WindowFrame> Of(vtkRenderWindow* window, int clock);

    // Weak, since a new window may get the address of a deleted one.
    vtkWeakPointer<vtkRenderWindow> Window;
    entire::frame_budget Budget;
    // True while the window draws.
    bool Drawing = false;
    double Start = 0;
    // False if the frame includes the reading of voxels.
    bool Usual = true;
    // The steerings in the window.
    std::vector<vtkInternals*> Steerings;
  };

  // One mapper that draws, with its session.
  class Leaf : public std::enable_shared_from_this<Leaf>
  {
  public:
    Leaf(vtkInternals* internals, const vtkEntire::LeafMapper& found);
    ~Leaf() { this->Release(); }
    Leaf(const Leaf&) = delete;
    void operator=(const Leaf&) = delete;

    // Stops observing the mapper and restores its settings. Later calls do nothing.
    void Release();

    // Called when the renderer begins and ends its frame, and when the mapper begins and ends its drawing.
    void RendererStart();
    void RendererEnd() { this->Restore(); }
    void Start();
    void End();

    // Reads the mapper's current volume, so that the first frame does not need to read it. An error is not reported
    // here, but by the first frame.
    void ReadAhead();

    // Drops the learned state.
    void Forget();

    vtkInternals* Internals;
    vtkWeakPointer<vtkVolumeMapper> Mapper;
    vtkWeakPointer<vtkSmartVolumeMapper> Outer;
    // True if the mapper is a vtkGPUVolumeRayCastMapper.
    const bool Gpu;
    // Shared with a running event handler, from which Forget() may be called.
    std::shared_ptr<entire::session> Session;
    // True if the state of LoadState() belongs to another mapper, model or clock.
    bool RefusedState = false;

  private:
    // True for a vtkFixedPointVolumeRayCastMapper. It reads its sample distances, and computes the opacities for them,
    // before it invokes its start event: so its settings are written at its renderer's start, and restored at its
    // renderer's end. Inside a smart mapper this is done only if the smart mapper is about to draw with it.
    bool SetEarly() const { return !this->Gpu; }
    // Returns the mapper that has the input, cropping and blend mode of the coming frame. A smart mapper passes its own
    // input, cropping and blend mode to its fixed-point mapper only while it draws, which is too late for SetEarly().
    // With a vector mode, the smart mapper passes another input, so the inner mapper's input of the last frame is used.
    vtkVolumeMapper* Source() const
    {
      vtkSmartVolumeMapper* const outer = this->SetEarly() ? this->Outer.GetPointer() : nullptr;
      return outer && outer->GetVectorMode() == vtkSmartVolumeMapper::DISABLED ? outer : this->Mapper.GetPointer();
    }
    // Brings the mapper's input up to date. Returns false if an observer of its pipeline ended the attachment.
    bool UpdateInput(vtkVolumeMapper* mapper);
    void Plan();
    void Restore();
    void DrainQueue();
    // Plans the frame and writes the mapper's settings; returns an error text on failure.
    std::string Prepare();
    // These functions read data that have changed since their last call, and pass them to the session. Those that
    // return a text return the error, or an empty text on success.
    std::string UpdateGrid(vtkVolumeMapper* mapper, vtkImageData* image, vtkVolumeProperty* property);
    std::string SetVolume();
    std::string SetTransferFunction(vtkVolumeProperty* property);
    std::string SetLimits(float finest, float coarsest, float image);
    void MarkChanges(const vtkEntire::ModeKey& mode, const entire::frame& frame);
    // Plans a frame that VTK draws without steering. `full` is true if the frame has the mapper's full quality, which
    // AutoAdjustSampleDistances may reduce. Only then is the frame's time observed.
    void PlanUnsteered(const entire::frame& frame, float target, bool still, bool full);
    // Writes the settings to the mapper.
    std::string Steer(vtkVolumeMapper* mapper, const vtkEntire::MapperSettings& settings);

    unsigned long Tags[2];
    bool Alive = true;
    // Position of the voxels, and the stamp of the inputs that it was read from.
    vtkEntire::GridStamp Stamp;
    vtkEntire::VoxelGrid Grid;
    // The last volume that cannot be used, and the reason.
    vtkEntire::VolumeKey RefusedVolume;
    std::string RefusedText;
    // Volume, transfer function and limits that the session has, for the detection of changes.
    vtkEntire::VolumeKey Volume;
    vtkEntire::TransferNodes Transfer;
    bool HasTransfer = false;
    std::array<float, 7> Limits{};
    // The property and its MTime when its functions were read, and these functions.
    const vtkVolumeProperty* Property = nullptr;
    vtkMTimeType PropertyTime = 0;
    vtkEntire::TransferNodes Nodes;
    vtkEntire::ModeKey Mode{ { -1, -1, -1, -1, -1, -1 } };
    std::array<double, 2> Range{ { 0, 1 } };
    std::optional<entire_frame> LastFrame;
    entire_plan Planned{};
    // The renderer whose frame is being steered.
    vtkWeakPointer<vtkRenderer> DrawnIn;
    // The settings of the mapper (and of the smart mapper around it) that the application set, and those that are
    // written for this frame.
    vtkEntire::MapperSettings Own;
    vtkEntire::MapperSettings Written;
    vtkEntire::SmartSettings OwnOuter;
    vtkEntire::SmartSettings WrittenOuter;
    bool Ready = false;
    bool Drawing = false;
    bool Steered = false;
    // True if the frame could not be predicted.
    bool FellBack = false;
    double StartTime = 0;
    // Processor time of the process at that time, in clock ticks; used only if the mapper draws on the processor.
    std::clock_t StartTicks = 0;
    // State of this mapper in the window's frame budget, and the mapper's estimated time at full quality divided by its
    // time at the planned settings.
    entire::pass Pass;
    double Coarsening = 1;
  };
  using Leaves = std::vector<std::shared_ptr<Leaf>>;

  explicit vtkInternals(vtkEntireSteering* owner)
    : Owner(owner)
  {
  }
  ~vtkInternals();

  // Returns the current time of LastClock, in seconds.
  double Now() const;

  // Names of the owner's clock and of the model's clock; nullptr if the model states none.
  const char* ClockName() const;
  const char* ModelClockName() const;
  // A sentence about both clocks, for Status.
  std::string ClocksText() const;
  // Stores the clock of a session's model, and warns if frames are timed by another clock: once for each change of one
  // of the two clocks.
  void NoteClocks(const entire::session& session);

  // Ends the attachment. Returns the leaves, which the caller must release; their release may invoke observers.
  Leaves TakeApart();
  static void ReleaseAll(const Leaves& leaves);

  // Leaves the shared frame of the last window, and joins the shared frame of `window` if it is not null.
  void Share(vtkRenderWindow* window);
  // True while a renderer of the window draws for a selector. Such a drawing is invisible, takes a different time, and
  // does not count as a frame.
  static bool IsPicking(vtkRenderWindow* window);

  void Observe(vtkRenderer* renderer);
  void ObserveWindow(vtkRenderWindow* window);
  void FindMappers();
  // Passes an event to every current leaf, even if the list changes meanwhile.
  void ForEach(void (Leaf::*handle)());
  void RendererStart();
  void RendererEnd();
  void WindowStart();
  void WindowEnd();
  // Drops the learned states of all leaves if the owner's ModelFileName, Tolerance, MissRate or IgnoreLoad has changed.
  void MatchOwner();
  // Makes a session for a leaf, with the names of the leaf's mapper and the owner's clock; returns an error text on
  // failure.
  std::string NewSession(const Leaf& leaf, std::optional<entire::session>& session);
  // Gives the leaf a session if it has none.
  std::string MakeSession(Leaf& leaf);
  // Checks that the session of at least one leaf accepts the state; without leaves, only that the state is valid.
  // Returns an error text if not.
  std::string Try(const std::vector<std::uint8_t>& state);

  // Sets the owner's Reason and Status; an argument of nullptr leaves its value unchanged. Invokes no event, since both
  // change in every frame.
  void Report(const char* reason, const char* status);
  // Called if VTK draws the current frame without steering: sets Status to the reason, and warns of each reason once per
  // attachment.
  void FallBack(const std::string& why);
  // Keeps a warning until the frame is over.
  void Warn(const std::string& text) { this->Warnings.push_back(text); }
  void SayWarnings();

  vtkEntireSteering* Owner;
  // Time that the event handlers have taken in the current frame.
  vtkEntire::Busy Busy;
  vtkWeakPointer<vtkRenderer> Renderer;
  vtkWeakPointer<vtkRenderWindow> Window;
  vtkWeakPointer<vtkVolume> Volume;
  unsigned long RendererTags[2] = { 0, 0 };
  unsigned long WindowTags[2] = { 0, 0 };
  // Number of attachments that have ended.
  std::size_t Attachment = 0;
  Leaves Drawing;
  std::vector<std::string> Warnings;
  // The reasons of frames that were not steered, of which the user was warned.
  std::set<std::string> Said;

  // Inputs of the sessions.
  std::optional<entire::model> Model;
  std::string ModelName;
  // Reason why the file with this name is not a model; empty if it is one or was not read.
  std::string RefusedModel;
  double Tolerance = -1;
  double MissRate = -1;
  bool IgnoreLoad = false;
  entire_clock ModelClock = ENTIRE_CLOCK_UNSTATED;
  // The last warning about the model's clock; empty if the two clocks agree.
  std::string ClocksSaid;
  std::vector<std::uint8_t> State;

  bool Rendering = false;
  // True if the renderer has the volume.
  bool Present = false;
  // State of the window's current frame.
  bool InFrame = false;
  std::shared_ptr<WindowFrame> Shared;
  double MapperSeconds = 0;
  // Sum of the predicted seconds of the mappers whose measured seconds are in MapperSeconds; NaN if one is unknown.
  double PredictedSeconds = 0;
  int Drawn = 0;
  // The owner's clock at the start of the window's last frame, or at Attach(). The owner's clock may change in a frame.
  int LastClock = -1;
  std::weak_ptr<Leaf> LastLeaf;
};

#endif
