// SPDX-License-Identifier: MIT OR Apache-2.0
// Steering of one mapper: plans its frame, writes its settings, restores them, and observes the frame's time.
#include "vtkEntireSteeringInternals.h"

#include "vtkAlgorithm.h"
#include "vtkCommand.h"
#include "vtkDataArray.h"
#include "vtkFixedPointVolumeRayCastMapper.h"
#include "vtkGPUVolumeRayCastMapper.h"
#include "vtkImageData.h"
#include "vtkNew.h"
#include "vtkSmartPointer.h"
#include "vtkVolumeProperty.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>

namespace
{
// The library's maximum image sample distance, as a multiple of the mapper's own.
constexpr double COARSEST_IMAGE = 64;
// Desired update rate, in frames per second, below which AutoAdjustSampleDistances leaves frames at full quality unless
// they take minutes.
constexpr double FULL_QUALITY_RATE = 0.01;
// VTK's maximum image sample distance, in pixels.
constexpr double COARSEST_IMAGE_OF_VTK = 100;

const char* ReasonName(entire_reason reason)
{
  switch (reason)
  {
    case ENTIRE_REASON_FITS:
      return "fits";
    case ENTIRE_REASON_DAMPED:
      return "damped";
    case ENTIRE_REASON_HELD:
      return "held";
    case ENTIRE_REASON_FINEST_ALLOWED:
      return "finest allowed";
    case ENTIRE_REASON_TARGET_UNREACHABLE:
      return "target unreachable";
    case ENTIRE_REASON_HISTORY:
      return "history";
    case ENTIRE_REASON_NO_INFORMATION:
      return "no information";
    case ENTIRE_REASON_OFF:
      return "off";
    default:
      return "reactive";
  }
}

// Restores settings a second time, at the renderer's end: when a fixed-point mapper has drawn, it overwrites its sample
// distance with the one from the start of its drawing.
class RestoreLater : public vtkCommand
{
public:
  static RestoreLater* New() { return new RestoreLater; }
  void Execute(vtkObject* renderer, unsigned long, void*) override
  {
    // The renderer holds a reference to this command while the command runs.
    renderer->RemoveObserver(this);
    const vtkSmartPointer<vtkVolumeMapper> mapper(this->Mapper);
    if (mapper)
    {
      this->Own.Keeping(vtkEntire::MapperSettings::Read(mapper, false), this->Written).Write(mapper, false);
    }
  }

  // A fixed-point mapper.
  vtkWeakPointer<vtkVolumeMapper> Mapper;
  vtkEntire::MapperSettings Own;
  vtkEntire::MapperSettings Written;
};
}

//------------------------------------------------------------------------------
vtkEntireSteering::vtkInternals::Leaf::Leaf(vtkInternals* internals, const vtkEntire::LeafMapper& found)
  : Internals(internals)
  , Mapper(found.Mapper)
  , Outer(found.Outer)
  , Gpu(found.Gpu)
{
  vtkVolumeMapper* mapper = found.Mapper;
  this->Tags[0] = mapper->AddObserver(vtkCommand::VolumeMapperRenderStartEvent, this, &Leaf::Start);
  this->Tags[1] = mapper->AddObserver(vtkCommand::VolumeMapperRenderEndEvent, this, &Leaf::End);
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Release()
{
  if (!this->Alive)
  {
    return;
  }
  this->Alive = false;
  this->Ready = false;
  this->Drawing = false;
  if (this->Mapper)
  {
    this->Mapper->RemoveObserver(this->Tags[0]);
    this->Mapper->RemoveObserver(this->Tags[1]);
  }
  if (this->Steered && this->SetEarly() && this->DrawnIn)
  {
    // This call comes during the renderer's frame, perhaps while the mapper draws.
    vtkNew<RestoreLater> later;
    later->Mapper = this->Mapper;
    later->Own = this->Own;
    later->Written = this->Written;
    this->DrawnIn->AddObserver(vtkCommand::EndEvent, later);
  }
  this->Restore();
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Forget()
{
  this->Volume = vtkEntire::VolumeKey();
  this->RefusedText.clear();
  this->HasTransfer = false;
  this->Limits.fill(0);
  this->Session.reset();
  this->Planned = {};
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::Leaf::UpdateGrid(
  vtkVolumeMapper* mapper, vtkImageData* image, vtkVolumeProperty* property)
{
  const vtkEntire::GridStamp stamp = vtkEntire::GridStamp::Of(mapper, image, property);
  if (stamp == this->Stamp)
  {
    return {};
  }
  this->Stamp = vtkEntire::GridStamp();
  std::string failure = vtkEntire::ReadGrid(mapper, image, property, this->Grid);
  if (failure.empty())
  {
    this->Stamp = stamp;
  }
  return failure;
}

//------------------------------------------------------------------------------
// Passes the voxels inside the cropping box to the session if they changed.
std::string vtkEntireSteering::vtkInternals::Leaf::SetVolume()
{
  if (this->Session && !(this->Grid.Key != this->Volume))
  {
    return {};
  }
  if (!this->RefusedText.empty() && !(this->Grid.Key != this->RefusedVolume))
  {
    return this->RefusedText;
  }
  const auto before = std::chrono::steady_clock::now();
  std::string failure = this->Internals->MakeSession(*this);
  if (!failure.empty())
  {
    return failure;
  }
  std::optional<entire::volume> volume;
  std::array<double, 2> range;
  vtkSmartPointer<vtkDataArray> kept;
  entire::failure refused = vtkEntire::ReadVoxels(this->Grid, volume, range, kept);
  if (refused.code == ENTIRE_OK)
  {
    // The session copies the data that it needs, so the borrowed voxels are read only during this call.
    auto set = this->Session->set_volume(*volume);
    refused = { set.code(), set.message() };
  }
  if (refused.code != ENTIRE_OK)
  {
    if (refused.code != ENTIRE_OUT_OF_MEMORY)
    {
      this->RefusedVolume = this->Grid.Key;
      this->RefusedText = refused.message;
    }
    return refused.message;
  }
  this->Volume = this->Grid.Key;
  this->HasTransfer = false;
  this->Range = range;
  if (this->Internals->Shared)
  {
    this->Internals->Shared->Usual = false;
  }
  this->Internals->Owner->NumberOfVolumeReadings++;
  this->Internals->Owner->VolumeTime =
    std::chrono::duration<double>(std::chrono::steady_clock::now() - before).count();
  return {};
}

//------------------------------------------------------------------------------
// Passes the transfer function to the session if its nodes or its unit distance changed.
std::string vtkEntireSteering::vtkInternals::Leaf::SetTransferFunction(vtkVolumeProperty* property)
{
  const vtkMTimeType time = property->GetMTime();
  if (this->HasTransfer && property == this->Property && time == this->PropertyTime)
  {
    return {};
  }
  // A property without functions creates them when they are read and invokes ModifiedEvent, whose observers may reset
  // this->Session.
  const std::shared_ptr<entire::session> session = this->Session;
  vtkEntire::ReadTransferNodes(property, this->Range, this->Nodes);
  if (!this->HasTransfer || !(this->Nodes == this->Transfer))
  {
    std::optional<entire::transfer_function> function;
    std::string failure = vtkEntire::MakeTransferFunction(this->Nodes, function);
    if (!failure.empty())
    {
      return failure;
    }
    auto set = session->set_transfer_function(*function);
    if (!set)
    {
      return set.message();
    }
    std::swap(this->Nodes, this->Transfer);
    this->HasTransfer = session == this->Session;
    this->Internals->Owner->NumberOfTransferFunctionReadings++;
  }
  this->Property = property;
  this->PropertyTime = time;
  return {};
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::Leaf::SetLimits(float finest, float coarsest, float image)
{
  const vtkEntireSteering* owner = this->Internals->Owner;
  const double* quality = this->Gpu ? owner->GPUQuality : owner->FixedPointQuality;
  std::array<float, 7> limits{ { finest, coarsest, image } };
  std::transform(quality, quality + 4, limits.begin() + 3, [](double q) { return static_cast<float>(q); });
  if (limits == this->Limits)
  {
    return {};
  }
  this->Limits.fill(0);
  for (const entire::status& set : { this->Session->set_limits(finest, coarsest),
         this->Session->set_max_image_sample_distance(image),
         this->Session->set_quality(limits[3], limits[4], limits[5], limits[6]) })
  {
    if (!set)
    {
      return set.message();
    }
  }
  this->Limits = limits;
  return {};
}

//------------------------------------------------------------------------------
// Announces changes that the library cannot detect: changed modes, and jumps of the camera.
void vtkEntireSteering::vtkInternals::Leaf::MarkChanges(
  const vtkEntire::ModeKey& mode, const entire::frame& frame)
{
  if (mode != this->Mode)
  {
    if (this->Mode[0] >= 0)
    {
      static_cast<void>(this->Session->mark(ENTIRE_CHANGE_MODE));
    }
    this->Mode = mode;
  }
  if (this->LastFrame && vtkEntire::Jumps(*this->LastFrame, frame))
  {
    static_cast<void>(this->Session->mark(ENTIRE_CHANGE_CAMERA));
  }
  this->LastFrame = frame;
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::Leaf::Prepare()
{
  vtkEntireSteering* owner = this->Internals->Owner;
  const vtkEntire::Hold<vtkRenderWindow> window(this->Internals->Window.GetPointer());
  const vtkEntire::Hold<vtkRenderer> renderer(this->Internals->Renderer.GetPointer());
  const vtkEntire::Hold<vtkVolume> volume(this->Internals->Volume.GetPointer());
  const vtkEntire::Hold<vtkVolumeMapper> mapper(this->Mapper.GetPointer());
  const vtkEntire::Hold<vtkVolumeProperty> property(volume ? volume->GetProperty() : nullptr);
  if (!window || !renderer || !property || !mapper)
  {
    return "the renderer has no window, or the volume has no property";
  }
  const vtkEntire::Hold<vtkVolumeMapper> source(this->Source());
  vtkDataSet* input = source->GetDataSetInput();
  const vtkEntire::Hold<vtkImageData> image(vtkImageData::SafeDownCast(input));
  if (!image)
  {
    return std::string("the mapper's input is ") + (input ? input->GetClassName() : "missing") +
      "; only vtkImageData is supported";
  }
  std::string failure = this->Internals->MakeSession(*this);
  if (!failure.empty())
  {
    return failure;
  }
  failure = this->UpdateGrid(source, image, property);
  if (!failure.empty())
  {
    return failure;
  }
  failure = this->SetVolume();
  if (!failure.empty())
  {
    return failure;
  }
  failure = this->SetTransferFunction(property);
  if (!failure.empty())
  {
    return failure;
  }

  const vtkEntire::VoxelGrid& grid = this->Grid;
  this->Own = vtkEntire::MapperSettings::Read(mapper, this->Gpu);
  const double rate = window->GetDesiredUpdateRate();
  const bool still = rate < owner->StillUpdateRate;
  // With AutoAdjustSampleDistances, the mapper's image sample distance is that of an earlier frame.
  const double ownImage = this->Own.AutoAdjust ? 1.0 : std::max(0.1f, this->Own.ImageSampleDistance);
  double finest = this->Own.SampleDistance;
  if (this->Gpu && this->Own.AutoAdjust)
  {
    finest = vtkEntire::PlacedSpacing(image, volume);
  }
  else if (this->Own.Lock)
  {
    finest = vtkEntire::SpacingAdjustedSampleDistance(mapper, image);
  }
  finest = std::min(4096.0, std::max(1.0 / 64, finest / grid.Reference));

  const int* size = renderer->GetSize();
  const auto shrunk = [&](int side, double by) {
    return static_cast<std::uint32_t>(std::min(16384.0, std::max(1.0, std::floor(side / by))));
  };
  entire::frame frame(shrunk(size[0], ownImage), shrunk(size[1], ownImage));
  // If SetEarly() is true, the mapper is planned before the renderer draws its props.
  vtkMatrix4x4* const placed =
    this->SetEarly() ? vtkEntire::DrawnMatrix(renderer, volume) : volume->GetMatrix();
  failure = vtkEntire::ReadCamera(renderer, placed, image, grid, frame);
  if (!failure.empty())
  {
    return failure;
  }
  if (!this->Alive || !this->Session)
  {
    // An observer of one of the objects read above has detached or reset the steering.
    return {};
  }
  const vtkEntire::ModeKey mode{ { property->GetShade(0), property->GetInterpolationType(),
    source->GetBlendMode(), property->HasGradientOpacity(0) && !property->GetDisableGradientOpacity(0),
    vtkEntire::Jitters(mapper, this->Gpu), vtkEntire::Scatters(mapper, this->Gpu) } };
  this->MarkChanges(mode, frame);
  frame.shading = mode[0] ? ENTIRE_SHADING_LOCAL : ENTIRE_SHADING_NONE;
  frame.skipping = this->Gpu ? ENTIRE_SKIPPING_NONE : ENTIRE_SKIPPING_BLOCKS;
  frame.termination = mode[2] == vtkVolumeMapper::COMPOSITE_BLEND ? (this->Gpu ? 0.996f : 0.99f) : 1.0f;
  frame.step = static_cast<float>(finest);

  const double wanted = owner->TargetFrameTime > 0 ? owner->TargetFrameTime : 1.0 / std::max(rate, 1.0e-4);
  const auto share = this->Internals->Shared
    ? this->Internals->Shared->Budget.share(this->Pass, static_cast<float>(wanted))
    : entire::plain_result<float>(static_cast<float>(wanted));
  if (!share)
  {
    return share.message();
  }
  const float target = share.value();
  owner->ShareTime = target;
  this->Coarsening = 1;
  if (still || !owner->Enabled)
  {
    this->PlanUnsteered(frame, target, still, !this->Own.AutoAdjust || (still && rate < FULL_QUALITY_RATE));
    if (this->Planned.id != 0)
    {
      owner->SampleDistance = finest * grid.Reference;
      owner->ImageSampleDistance = ownImage;
    }
    return {};
  }

  if (owner->FinestSampleDistance > 0)
  {
    finest = std::max(1.0 / 64, owner->FinestSampleDistance);
  }
  const double coarsest = std::max(finest, owner->CoarsestSampleDistance);
  // The GPU mapper draws smaller images only in viewports at the window's origin, and nothing elsewhere.
  const int* const origin = renderer->GetOrigin();
  const bool whole = !this->Gpu || (origin[0] == 0 && origin[1] == 0);
  const double coarsestImage = whole ? std::max(ownImage, owner->CoarsestImageSampleDistance) : ownImage;
  // Plans coarsen ray step and image together, according to the quality law.
  frame.step = static_cast<float>(finest);
  failure = this->SetLimits(static_cast<float>(finest), static_cast<float>(coarsest),
    static_cast<float>(std::min(COARSEST_IMAGE, coarsestImage / ownImage)));
  if (!failure.empty())
  {
    return failure;
  }
  auto planned = this->Session->plan(frame, target);
  if (!planned)
  {
    return planned.message();
  }
  this->Planned = planned.value();
  this->Coarsening =
    this->Planned.step / finest * this->Planned.image_sample_distance * this->Planned.image_sample_distance;
  vtkEntire::MapperSettings settings;
  settings.AutoAdjust = 0;
  settings.Lock = 0;
  settings.SampleDistance = static_cast<float>(this->Planned.step * grid.Reference);
  settings.ImageSampleDistance =
    static_cast<float>(std::min(COARSEST_IMAGE_OF_VTK, ownImage * this->Planned.image_sample_distance));
  return this->Steer(mapper, settings);
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::PlanUnsteered(
  const entire::frame& frame, float target, bool still, bool full)
{
  this->Internals->Report(
    still ? "still" : "off", still ? "a still frame, drawn by VTK alone" : "steering is off");
  if (full)
  {
    static_cast<void>(this->Session->set_enabled(false));
    auto plan = this->Session->plan(frame, target);
    static_cast<void>(this->Session->set_enabled(true));
    if (plan)
    {
      this->Planned = plan.value();
    }
  }
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::Leaf::Steer(
  vtkVolumeMapper* mapper, const vtkEntire::MapperSettings& settings)
{
  if (!vtkEntire::ClaimMapper(mapper, this))
  {
    this->Planned = {};
    return "another vtkEntireSteering steers the same mapper in the same renderer; detach one of the two";
  }
  const char* const reason = ReasonName(this->Planned.reason);
  vtkSmartVolumeMapper* const outer = this->SetEarly() ? this->Outer.GetPointer() : nullptr;
  this->Written = settings;
  if (outer)
  {
    this->OwnOuter = vtkEntire::SmartSettings::Read(outer);
    this->WrittenOuter = { 0, 0, settings.SampleDistance };
  }
  this->DrawnIn = this->Internals->Renderer;
  this->Steered = true;
  settings.Write(mapper, this->Gpu);
  if (outer)
  {
    this->WrittenOuter.Write(outer);
  }
  vtkEntireSteering* owner = this->Internals->Owner;
  this->Internals->Report(reason, "");
  owner->SampleDistance = settings.SampleDistance;
  owner->ImageSampleDistance = settings.ImageSampleDistance;
  return {};
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::ReadAhead()
{
  const vtkSmartPointer<vtkVolumeMapper> mapper(this->Mapper);
  const vtkSmartPointer<vtkVolume> volume(this->Internals->Volume);
  // A smart mapper connects the inputs of its mappers only if it draws with them.
  const vtkSmartPointer<vtkVolumeMapper> source(mapper && mapper->GetDataSetInput() ? this->Source() : nullptr);
  vtkImageData* image = source ? vtkImageData::SafeDownCast(source->GetDataSetInput()) : nullptr;
  if (image && volume && volume->GetProperty() && this->Internals->MakeSession(*this).empty() &&
    this->UpdateGrid(source, image, volume->GetProperty()).empty())
  {
    static_cast<void>(this->SetVolume());
  }
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::vtkInternals::Leaf::UpdateInput(vtkVolumeMapper* mapper)
{
  if (!mapper->GetInputAlgorithm())
  {
    return true;
  }
  {
    const vtkEntire::Hold<vtkAlgorithm> pipeline(mapper->GetInputAlgorithm());
    const vtkEntire::Busy::Elsewhere elsewhere(this->Internals->Busy);
    pipeline->Update();
  }
  return this->Alive && this->Internals->Renderer;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::RendererStart()
{
  const std::shared_ptr<Leaf> self = this->shared_from_this();
  const vtkEntire::Hold<vtkVolumeMapper> mapper(this->Mapper.GetPointer());
  const vtkEntire::Hold<vtkVolume> volume(this->Internals->Volume.GetPointer());
  this->Ready = false;
  if (!this->Alive || !mapper || !this->SetEarly() || !volume || !volume->GetVisibility())
  {
    return;
  }
  if (this->Outer)
  {
    // The requested render mode of a smart mapper, else the last used one, tells which inner mapper will draw.
    const int mode = this->Outer->GetRequestedRenderMode();
    if ((mode == vtkSmartVolumeMapper::DefaultRenderMode ? this->Outer->GetLastUsedRenderMode() : mode) !=
      vtkSmartVolumeMapper::RayCastRenderMode)
    {
      return;
    }
    if (!mapper->GetDataSetInput())
    {
      // The smart mapper connects the input in its first frame.
      return;
    }
  }
  const vtkEntire::Hold<vtkVolumeMapper> source(this->Source());
  if (!this->UpdateInput(source) || !vtkEntire::IsDrawnBy(this->Internals->Renderer, volume))
  {
    // An observer of the pipeline ended the attachment, or removed the volume from the renderer.
    return;
  }
  this->Plan();
  this->Ready = this->Alive;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Start()
{
  const vtkSmartPointer<vtkEntireSteering> owner(this->Internals->Owner);
  const std::shared_ptr<Leaf> self = this->shared_from_this();
  const vtkEntire::Busy::Handling handling(this->Internals->Busy);
  // Another renderer, or another volume, may draw the same mapper.
  if (!this->Internals->Rendering || !this->Internals->Present || !this->Internals->Renderer)
  {
    return;
  }
  if (!this->Ready)
  {
    if (this->SetEarly())
    {
      return;
    }
    // The filter by which a smart mapper resamples the volume may not have run yet.
    const vtkEntire::Hold<vtkVolumeMapper> mapper(this->Mapper.GetPointer());
    if (this->Outer && !this->UpdateInput(mapper))
    {
      return;
    }
    this->Plan();
    if (!this->Alive)
    {
      return;
    }
  }
  this->Ready = false;
  this->Drawing = true;
  if (this->Steered)
  {
    owner->NumberOfSteeredFrames++;
  }
  else if (this->FellBack)
  {
    owner->NumberOfFallbackFrames++;
  }
  this->DrainQueue();
  this->StartTime = this->Internals->Now();
  this->StartTicks = this->Gpu ? 0 : std::clock();
}

//------------------------------------------------------------------------------
// Waits until the graphics device has finished its work. Called before and after the mapper draws, so that the time
// between the two calls is the mapper's alone.
void vtkEntireSteering::vtkInternals::Leaf::DrainQueue()
{
  vtkRenderWindow* const window = this->Internals->Window;
  if (this->Gpu && window)
  {
    const vtkEntire::Busy::Elsewhere elsewhere(this->Internals->Busy);
    window->WaitForCompletion();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Plan()
{
  vtkEntireSteering* owner = this->Internals->Owner;
  this->Restore();
  this->Planned = {};
  const std::string failure = this->Prepare();
  this->FellBack = !failure.empty();
  if (!this->Alive)
  {
    return;
  }
  if (!failure.empty())
  {
    this->Planned = {};
    this->Internals->FallBack(failure);
  }
  const bool known = this->Planned.id != 0;
  owner->PredictedTime =
    known && !(this->Planned.absent & ENTIRE_ABSENT_SECONDS) ? this->Planned.seconds : vtkEntire::NOT_KNOWN;
  if (!known)
  {
    owner->SampleDistance = vtkEntire::NOT_KNOWN;
    owner->ImageSampleDistance = vtkEntire::NOT_KNOWN;
  }
}

//------------------------------------------------------------------------------
// Restores the application's settings; settings that the application changed during the frame stay.
void vtkEntireSteering::vtkInternals::Leaf::Restore()
{
  if (!this->Steered)
  {
    return;
  }
  this->Steered = false;
  vtkEntire::ReleaseClaim(this);
  vtkVolumeMapper* const mapper = this->Mapper;
  vtkSmartVolumeMapper* const outer = this->SetEarly() ? this->Outer.GetPointer() : nullptr;
  if (mapper)
  {
    this->Own.Keeping(vtkEntire::MapperSettings::Read(mapper, this->Gpu), this->Written).Write(mapper, this->Gpu);
  }
  if (outer)
  {
    this->OwnOuter.Keeping(vtkEntire::SmartSettings::Read(outer), this->WrittenOuter).Write(outer);
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::End()
{
  const vtkSmartPointer<vtkEntireSteering> owner(this->Internals->Owner);
  const std::shared_ptr<Leaf> self = this->shared_from_this();
  const vtkEntire::Busy::Handling handling(this->Internals->Busy);
  if (!this->Drawing)
  {
    return;
  }
  this->DrainQueue();
  const double seconds = this->Internals->Now() - this->StartTime;
  const std::clock_t ticks = this->Gpu ? 0 : std::clock() - this->StartTicks;
  const bool steered = this->Steered;
  this->Drawing = false;
  if (!this->SetEarly())
  {
    this->Restore();
  }
  else if (this->Steered && this->Mapper)
  {
    // Keeps what the application changed, since the fixed-point mapper is about to overwrite its sample distance with
    // the one from the start of its drawing. RendererEnd() restores the settings.
    this->Own = this->Own.Keeping(vtkEntire::MapperSettings::Read(this->Mapper, false), this->Written);
  }
  const bool known = this->Planned.id != 0 && !(this->Planned.absent & ENTIRE_ABSENT_SECONDS);
  this->Internals->PredictedSeconds += known ? this->Planned.seconds : vtkEntire::NOT_KNOWN;
  if (this->Planned.id != 0 && this->Session)
  {
    vtkRenderWindow* window = this->Internals->Window;
    const bool aborted = window && window->GetAbortRender();
    if (!this->Gpu)
    {
      const double processorSeconds = static_cast<double>(ticks) / CLOCKS_PER_SEC;
      static_cast<void>(this->Session->set_processor_seconds(static_cast<float>(processorSeconds)));
    }
    // A time that the library refuses has no effect.
    static_cast<void>(this->Session->observe(
      this->Planned.id, static_cast<float>(seconds), aborted ? ENTIRE_OBSERVE_CANCELLED : 0));
    this->Planned = {};
  }
  // The time of a mapper that is not steered counts as time outside of the passes, which reduces the shares of the
  // steered mappers.
  if (steered && this->Internals->InFrame && this->Internals->Shared)
  {
    static_cast<void>(this->Internals->Shared->Budget.drew(
      this->Pass, static_cast<float>(seconds), static_cast<float>(seconds * this->Coarsening)));
  }
  this->Internals->MapperSeconds += seconds;
  this->Internals->Drawn++;
  this->Internals->LastLeaf = self;
}
