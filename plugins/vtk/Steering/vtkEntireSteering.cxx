// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireSteering.h"

#include "vtkAbstractMapper.h"
#include "vtkAlgorithm.h"
#include "vtkCamera.h"
#include "vtkColorTransferFunction.h"
#include "vtkCommand.h"
#include "vtkDataArray.h"
#include "vtkFixedPointVolumeRayCastMapper.h"
#include "vtkGPUVolumeRayCastMapper.h"
#include "vtkImageData.h"
#include "vtkMath.h"
#include "vtkMatrix3x3.h"
#include "vtkMatrix4x4.h"
#include "vtkMultiBlockVolumeMapper.h"
#include "vtkObjectFactory.h"
#include "vtkPiecewiseFunction.h"
#include "vtkRenderWindow.h"
#include "vtkRenderer.h"
#include "vtkSmartVolumeMapper.h"
#include "vtkVolume.h"
#include "vtkVolumeMapper.h"
#include "vtkVolumeProperty.h"
#include "vtkWeakPointer.h"

#include <entire/entire.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <fstream>
#include <iterator>
#include <limits>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

vtkStandardNewMacro(vtkEntireSteering);

namespace
{
constexpr double NOT_KNOWN = std::numeric_limits<double>::quiet_NaN();

// How many frames the time outside of the mapper is taken from.
constexpr std::size_t REST_FRAMES = 5;

// Rays along each side of the probe that frames are measured with for a linear cost model; a network's file names its own.
// Fewer than the library's default: between frames that sweep the caches a ray costs most of a microsecond. With fewer
// still, frames of sparse volumes are held less well.
constexpr std::uint32_t PROBE_SIDE = 6;

// Coarsening of the GPU mapper's step before its image shrinks.
constexpr float GPU_STEP_ALONE = 2.1f;

// Least share of the target that a mapper is given, however much the rest of the frame takes.
constexpr double LEAST_SHARE = 0.2;

// A mapper that draws, and the smart mapper that it is inside of, if any.
struct Found
{
  vtkVolumeMapper* Mapper;
  vtkSmartVolumeMapper* Outer;
};

// The mappers inside vtkSmartVolumeMapper are protected: a derived class may name them.
struct SmartMembers : vtkSmartVolumeMapper
{
  static void Inner(vtkSmartVolumeMapper* smart, std::vector<Found>& found)
  {
    vtkVolumeMapper* const inner[] = { smart->*&SmartMembers::GPUMapper, smart->*&SmartMembers::GPULowResMapper,
      smart->*&SmartMembers::RayCastMapper };
    for (vtkVolumeMapper* mapper : inner)
    {
      if (mapper)
      {
        found.push_back({ mapper, smart });
      }
    }
  }
};

struct SpacingMembers : vtkVolumeMapper
{
  static double Adjusted(vtkVolumeMapper* mapper, double spacing[3], int extent[6])
  {
    return (mapper->*&SpacingMembers::SpacingAdjustedSampleDistance)(spacing, extent);
  }
};

// Those of vtkMultiBlockVolumeMapper are private and nothing gives them out. An explicit instantiation may name private
// members; this one hands out the pointer to the member.
template <typename Tag, typename Tag::Type Member>
struct MemberOf
{
  friend typename Tag::Type Find(Tag) { return Member; }
};
struct BlockMappers
{
  using Type = std::vector<vtkSmartVolumeMapper*> vtkMultiBlockVolumeMapper::*;
  friend Type Find(BlockMappers);
};
template struct MemberOf<BlockMappers, &vtkMultiBlockVolumeMapper::Mappers>;

// The mappers that draw: the given one, or those inside it.
void FindLeaves(vtkAbstractVolumeMapper* mapper, std::vector<Found>& found)
{
  if (auto* blocks = vtkMultiBlockVolumeMapper::SafeDownCast(mapper))
  {
    for (vtkSmartVolumeMapper* block : blocks->*Find(BlockMappers()))
    {
      FindLeaves(block, found);
    }
  }
  else if (auto* smart = vtkSmartVolumeMapper::SafeDownCast(mapper))
  {
    SmartMembers::Inner(smart, found);
  }
  else if (vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper) || vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
  {
    found.push_back({ vtkVolumeMapper::SafeDownCast(mapper), nullptr });
  }
}

// The settings of a mapper that steering changes.
struct Knobs
{
  float SampleDistance = 1.0f;
  float ImageSampleDistance = 1.0f;
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool Lock = 0;

  template <class Mapper>
  static Knobs Of(Mapper* mapper)
  {
    Knobs knobs;
    knobs.SampleDistance = mapper->GetSampleDistance();
    knobs.ImageSampleDistance = mapper->GetImageSampleDistance();
    knobs.AutoAdjust = mapper->GetAutoAdjustSampleDistances();
    knobs.Lock = mapper->GetLockSampleDistanceToInputSpacing();
    return knobs;
  }
  template <class Mapper>
  void To(Mapper* mapper) const
  {
    mapper->SetAutoAdjustSampleDistances(this->AutoAdjust);
    mapper->SetLockSampleDistanceToInputSpacing(this->Lock);
    mapper->SetSampleDistance(this->SampleDistance);
    mapper->SetImageSampleDistance(this->ImageSampleDistance);
  }

  static Knobs Read(vtkVolumeMapper* mapper)
  {
    if (auto* gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
    {
      return Of(gpu);
    }
    return Of(vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper));
  }
  void Write(vtkVolumeMapper* mapper) const
  {
    if (auto* gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
    {
      this->To(gpu);
    }
    else if (auto* cpu = vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper))
    {
      this->To(cpu);
    }
  }
};

// The settings of a smart mapper that would undo those of the fixed-point mapper inside it.
struct OuterKnobs
{
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool InteractiveAdjust = 0;
  float SampleDistance = -1.0f;

  static OuterKnobs Read(vtkSmartVolumeMapper* mapper)
  {
    return { mapper->GetAutoAdjustSampleDistances(), mapper->GetInteractiveAdjustSampleDistances(),
      mapper->GetSampleDistance() };
  }
  void Write(vtkSmartVolumeMapper* mapper) const
  {
    mapper->SetAutoAdjustSampleDistances(this->AutoAdjust);
    mapper->SetInteractiveAdjustSampleDistances(this->InteractiveAdjust);
    mapper->SetSampleDistance(this->SampleDistance);
  }
};

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

// The library's name of a VTK scalar type, 0 where it has none.
entire_scalar_type ScalarType(int type)
{
  switch (type)
  {
    case VTK_FLOAT:
      return ENTIRE_SCALAR_F32;
    case VTK_DOUBLE:
      return ENTIRE_SCALAR_F64;
    case VTK_CHAR:
      return std::numeric_limits<char>::is_signed ? ENTIRE_SCALAR_I8 : ENTIRE_SCALAR_U8;
    case VTK_SIGNED_CHAR:
      return ENTIRE_SCALAR_I8;
    case VTK_UNSIGNED_CHAR:
      return ENTIRE_SCALAR_U8;
    case VTK_SHORT:
      return ENTIRE_SCALAR_I16;
    case VTK_UNSIGNED_SHORT:
      return ENTIRE_SCALAR_U16;
    case VTK_INT:
      return ENTIRE_SCALAR_I32;
    case VTK_UNSIGNED_INT:
      return ENTIRE_SCALAR_U32;
    case VTK_LONG:
      return sizeof(long) == 8 ? ENTIRE_SCALAR_I64 : ENTIRE_SCALAR_I32;
    case VTK_UNSIGNED_LONG:
      return sizeof(long) == 8 ? ENTIRE_SCALAR_U64 : ENTIRE_SCALAR_U32;
    case VTK_LONG_LONG:
    case VTK_ID_TYPE:
      return ENTIRE_SCALAR_I64;
    case VTK_UNSIGNED_LONG_LONG:
      return ENTIRE_SCALAR_U64;
    default:
      return 0;
  }
}

double Unit(double value)
{
  return std::isnan(value) ? 0.0 : std::min(1.0, std::max(0.0, value));
}

// The volume property's functions as the library takes them.
entire::result<entire::transfer_function> MakeTransferFunction(
  vtkVolumeProperty* property, double low, double high)
{
  std::vector<entire_opacity_node> opacities;
  vtkPiecewiseFunction* opacity = property->GetScalarOpacity(0);
  for (int i = 0; i < opacity->GetSize(); ++i)
  {
    double node[4];
    opacity->GetNodeValue(i, node);
    opacities.push_back({ node[0], Unit(node[1]), Unit(node[2]), Unit(node[3]) });
  }
  std::vector<entire_color_node> colors;
  if (property->GetColorChannels(0) == 3)
  {
    vtkColorTransferFunction* color = property->GetRGBTransferFunction(0);
    for (int i = 0; i < color->GetSize(); ++i)
    {
      double node[6];
      color->GetNodeValue(i, node);
      colors.push_back(
        { node[0], { Unit(node[1]), Unit(node[2]), Unit(node[3]) }, Unit(node[4]), Unit(node[5]) });
    }
  }
  return entire::transfer_function::from_nodes(opacities, colors, low, high, opacity->GetClamping() != 0);
}

// What a predictor's volume was made from. Reading it again is needed when one of these changes.
struct VolumeKey
{
  vtkDataArray* Array = nullptr;
  vtkMTimeType Time = 0;
  int Component = 0;
  std::array<int, 3> Dimensions{ { 0, 0, 0 } };
  std::array<double, 3> Spacing{ { 0, 0, 0 } };
  std::array<int, 6> Box{ { 0, -1, 0, -1, 0, -1 } };

  bool operator!=(const VolumeKey& o) const
  {
    return this->Array != o.Array || this->Time != o.Time || this->Component != o.Component ||
      this->Dimensions != o.Dimensions || this->Spacing != o.Spacing || this->Box != o.Box;
  }
};

struct TransferKey
{
  vtkVolumeProperty* Property = nullptr;
  vtkMTimeType Time = 0;
  double Range[2] = { 0, 0 };

  bool operator!=(const TransferKey& o) const
  {
    return this->Property != o.Property || this->Time != o.Time || this->Range[0] != o.Range[0] ||
      this->Range[1] != o.Range[1];
  }
};

using ModeKey = std::array<int, 4>;
} // namespace

class vtkEntireSteering::vtkInternals
{
public:
  // One mapper that draws, and what is known of it.
  class Leaf
  {
  public:
    Leaf(vtkInternals* internals, const Found& found)
      : Internals(internals)
      , Mapper(found.Mapper)
      , Outer(found.Outer)
    {
      vtkVolumeMapper* mapper = found.Mapper;
      this->Tags[0] = mapper->AddObserver(vtkCommand::VolumeMapperRenderStartEvent, this, &Leaf::Start);
      this->Tags[1] = mapper->AddObserver(vtkCommand::VolumeMapperRenderEndEvent, this, &Leaf::End);
    }
    ~Leaf()
    {
      if (this->Mapper)
      {
        this->Mapper->RemoveObserver(this->Tags[0]);
        this->Mapper->RemoveObserver(this->Tags[1]);
        this->Restore();
      }
    }
    Leaf(const Leaf&) = delete;
    void operator=(const Leaf&) = delete;

    // The renderer begins and ends its frame; the mapper begins and ends.
    void RendererStart();
    void RendererEnd() { this->Restore(); }
    void Start();
    void End();

    // Reads the volume that the mapper has already, so that the first frame need not; what cannot be read yet, or not at
    // all, is for the first frame to say.
    void ReadAhead();

    // Forgets what was learned.
    void Forget()
    {
      this->Volume = VolumeKey();
      this->Predictor.reset();
      this->Planned = {};
    }

    vtkInternals* Internals;
    vtkWeakPointer<vtkVolumeMapper> Mapper;
    vtkWeakPointer<vtkSmartVolumeMapper> Outer;
    std::optional<entire::predictor> Predictor;

  private:
    // vtkFixedPointVolumeRayCastMapper takes its sample distances, and the opacities that go with them, before it
    // announces its start: it is set when its renderer starts, and put back when its renderer is done. It lies that far
    // ahead only where nobody sets it in between, so not inside a smart mapper that draws otherwise.
    bool SetEarly() const
    {
      return vtkFixedPointVolumeRayCastMapper::SafeDownCast(this->Mapper) != nullptr;
    }
    void Plan();
    void Restore();
    // Plans the frame and sets the mapper; on failure returns why.
    std::string Prepare();
    std::string SetVolume(vtkImageData* image, vtkVolumeProperty* property, double center[3], double& spacing);
    std::string SetCamera(entire::frame& frame, vtkImageData* image, const double center[3]);

    unsigned long Tags[2];
    VolumeKey Volume;
    TransferKey Transfer;
    ModeKey Mode{ { -1, -1, -1, -1 } };
    double Range[2] = { 0, 1 };
    float LastView[16];
    bool HasView = false;
    Knobs Own;
    entire_plan Planned{};
    OuterKnobs OwnOuter;
    bool Ready = false;
    bool Drawing = false;
    bool Steered = false;
    double StartTime = 0;
  };

  explicit vtkInternals(vtkEntireSteering* owner)
    : Owner(owner)
  {
  }
  ~vtkInternals() { this->Release(); }

  double Now() const
  {
    if (this->Owner->Clock == PROCESS_CPU)
    {
      return static_cast<double>(std::clock()) / CLOCKS_PER_SEC;
    }
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
  }

  void Release();
  void Observe(vtkRenderer* renderer);
  void ObserveWindow(vtkRenderWindow* window);
  void FindMappers();
  void RendererStart();
  void RendererEnd();
  void WindowStart();
  void WindowEnd();
  std::string MakePredictor(Leaf& leaf);

  // Seconds of a frame that pass outside of the mapper.
  double Rest() const
  {
    if (this->RestCount == 0)
    {
      return 0;
    }
    std::array<double, REST_FRAMES> sorted = this->Rests;
    const std::size_t n = std::min(this->RestCount, REST_FRAMES);
    std::sort(sorted.begin(), sorted.begin() + n);
    return sorted[n / 2];
  }

  vtkEntireSteering* Owner;
  vtkWeakPointer<vtkRenderer> Renderer;
  vtkWeakPointer<vtkRenderWindow> Window;
  vtkWeakPointer<vtkVolume> Volume;
  unsigned long RendererTags[2] = { 0, 0 };
  unsigned long WindowTags[2] = { 0, 0 };
  std::vector<std::unique_ptr<Leaf>> Leaves;

  // What the predictors were made with.
  std::optional<entire::model> Model;
  std::string ModelName;
  double Tolerance = -1;
  double MissRate = -1;
  std::vector<std::uint8_t> State;

  bool Rendering = false;
  // Of the window's frame at hand.
  bool InFrame = false;
  double FrameStart = 0;
  double MapperSeconds = 0;
  int Drawn = 0;
  bool Clean = true;
  // Of earlier frames.
  int LeavesLastFrame = 1;
  std::size_t Frames = 0;
  std::array<double, REST_FRAMES> Rests{};
  std::size_t RestCount = 0;
  int LastClock = -1;
  Leaf* LastLeaf = nullptr;
};

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Release()
{
  this->Leaves.clear();
  this->LastLeaf = nullptr;
  if (this->Renderer)
  {
    this->Renderer->RemoveObserver(this->RendererTags[0]);
    this->Renderer->RemoveObserver(this->RendererTags[1]);
  }
  this->ObserveWindow(nullptr);
  this->Renderer = nullptr;
  this->Volume = nullptr;
  this->Rendering = false;
  this->Frames = 0;
  this->RestCount = 0;
  this->LeavesLastFrame = 1;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Observe(vtkRenderer* renderer)
{
  this->Renderer = renderer;
  // Before other observers of the start, so that what they do counts as part of the frame.
  this->RendererTags[0] =
    renderer->AddObserver(vtkCommand::StartEvent, this, &vtkInternals::RendererStart, 1.0f);
  this->RendererTags[1] = renderer->AddObserver(vtkCommand::EndEvent, this, &vtkInternals::RendererEnd);
  this->ObserveWindow(renderer->GetRenderWindow());
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
  this->InFrame = false;
  this->Window = window;
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
  // A mapper that is not inside another is found at a glance.
  if (this->Volume && this->Leaves.size() == 1 && !this->Leaves[0]->Outer &&
    this->Leaves[0]->Mapper.GetPointer() == this->Volume->GetMapper())
  {
    return;
  }
  std::vector<Found> found;
  if (this->Volume)
  {
    FindLeaves(this->Volume->GetMapper(), found);
  }
  auto gone = [&](const std::unique_ptr<Leaf>& leaf) {
    return !leaf->Mapper ||
      std::none_of(found.begin(), found.end(), [&](const Found& f) { return f.Mapper == leaf->Mapper.GetPointer(); });
  };
  if (std::any_of(this->Leaves.begin(), this->Leaves.end(), gone))
  {
    this->LastLeaf = nullptr;
    this->Leaves.erase(std::remove_if(this->Leaves.begin(), this->Leaves.end(), gone), this->Leaves.end());
  }
  for (const Found& each : found)
  {
    auto is = [&](const std::unique_ptr<Leaf>& leaf) { return leaf->Mapper == each.Mapper; };
    if (std::none_of(this->Leaves.begin(), this->Leaves.end(), is))
    {
      this->Leaves.push_back(std::make_unique<Leaf>(this, each));
    }
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::RendererStart()
{
  this->Rendering = true;
  if (this->Renderer)
  {
    this->ObserveWindow(this->Renderer->GetRenderWindow());
  }
  this->FindMappers();
  for (auto& leaf : this->Leaves)
  {
    leaf->RendererStart();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::RendererEnd()
{
  this->Rendering = false;
  for (auto& leaf : this->Leaves)
  {
    leaf->RendererEnd();
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::WindowStart()
{
  this->InFrame = true;
  this->MapperSeconds = 0;
  this->Drawn = 0;
  this->Clean = true;
  if (this->LastClock != this->Owner->Clock)
  {
    this->LastClock = this->Owner->Clock;
    this->RestCount = 0;
    for (auto& leaf : this->Leaves)
    {
      leaf->Forget();
    }
  }
  this->FrameStart = this->Now();
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::WindowEnd()
{
  if (!this->InFrame)
  {
    return;
  }
  const double seconds = this->Now() - this->FrameStart;
  this->InFrame = false;
  // A multi-block mapper makes its mappers while it draws: they are steered from the next frame on.
  this->FindMappers();
  if (this->Drawn == 0)
  {
    return;
  }
  this->LeavesLastFrame = this->Drawn;
  // The first frame holds what is done once.
  if (this->Frames++ > 0 && this->Clean)
  {
    this->Rests[this->RestCount++ % REST_FRAMES] = std::max(0.0, seconds - this->MapperSeconds);
  }
  this->Owner->FrameTime = seconds;
  this->Owner->MeasuredTime = this->MapperSeconds;
  this->Owner->InvokeEvent(FrameEvent);
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::MakePredictor(Leaf& leaf)
{
  const char* const name = this->Owner->ModelFileName ? this->Owner->ModelFileName : "";
  if (this->ModelName != name || this->Tolerance != this->Owner->Tolerance || this->MissRate != this->Owner->MissRate)
  {
    for (auto& each : this->Leaves)
    {
      each->Forget();
    }
    if (this->ModelName != name)
    {
      this->Model.reset();
    }
    this->ModelName = name;
    this->Tolerance = this->Owner->Tolerance;
    this->MissRate = this->Owner->MissRate;
  }
  if (leaf.Predictor)
  {
    return {};
  }
  if (!this->Model && *name)
  {
    auto opened = entire::model::open(name);
    if (!opened)
    {
      return opened.message();
    }
    this->Model.emplace(std::move(opened.value()));
  }
  entire::predictor_options options;
  options.tolerance = static_cast<float>(this->Tolerance);
  options.miss_rate = static_cast<float>(this->MissRate);
  options.probe_side = PROBE_SIDE;
  auto made =
    this->Model ? entire::predictor::create(*this->Model, options) : entire::predictor::untrained(options);
  if (!made)
  {
    return made.message();
  }
  if (!this->State.empty())
  {
    auto loaded = made.value().load_state(this->State);
    if (!loaded)
    {
      return loaded.message();
    }
  }
  leaf.Predictor.emplace(std::move(made.value()));
  return {};
}

//------------------------------------------------------------------------------
// Hands the voxels (those inside the cropping box) to the predictor when they changed.
std::string vtkEntireSteering::vtkInternals::Leaf::SetVolume(
  vtkImageData* image, vtkVolumeProperty* property, double center[3], double& reference)
{
  vtkVolumeMapper* mapper = this->Mapper;
  int onCells = 0;
  vtkDataArray* scalars = vtkAbstractMapper::GetScalars(image, mapper->GetScalarMode(), mapper->GetArrayAccessMode(),
    mapper->GetArrayId(), mapper->GetArrayName(), onCells);
  if (!scalars)
  {
    return "the mapper's input has no scalars to draw";
  }
  const entire_scalar_type type = ScalarType(scalars->GetDataType());
  if (type == 0)
  {
    return std::string("scalars of type ") + scalars->GetDataTypeAsString() + " cannot be predicted";
  }
  VolumeKey key;
  key.Array = scalars;
  key.Time = scalars->GetMTime();
  const int components = scalars->GetNumberOfComponents();
  // Dependent components end with the one that opacity comes from.
  key.Component = property->GetIndependentComponents() ? 0 : components - 1;
  image->GetDimensions(key.Dimensions.data());
  image->GetSpacing(key.Spacing.data());
  std::size_t voxels = 1;
  for (int& n : key.Dimensions)
  {
    n -= onCells ? 1 : 0;
    if (n < 1)
    {
      return "the mapper's input is empty";
    }
    voxels *= static_cast<std::size_t>(n);
  }
  if (static_cast<std::size_t>(scalars->GetNumberOfTuples()) != voxels)
  {
    return "the mapper's input has " + std::to_string(scalars->GetNumberOfTuples()) + " scalar values for " +
      std::to_string(voxels) + " voxels";
  }
  for (int axis = 0; axis < 3; ++axis)
  {
    key.Box[2 * axis] = 0;
    key.Box[2 * axis + 1] = key.Dimensions[axis] - 1;
    key.Spacing[axis] = std::fabs(key.Spacing[axis]);
    if (!(key.Spacing[axis] > 0) || !std::isfinite(key.Spacing[axis]))
    {
      return "the mapper's input has a spacing of " + std::to_string(key.Spacing[axis]);
    }
  }
  if (mapper->GetCropping() && mapper->GetCroppingRegionFlags() == VTK_CROP_SUBVOLUME)
  {
    const double* planes = mapper->GetCroppingRegionPlanes();
    const double* origin = image->GetOrigin();
    const int* extent = image->GetExtent();
    for (int axis = 0; axis < 3; ++axis)
    {
      const double last = key.Dimensions[axis] - 1;
      double low = (planes[2 * axis] - origin[axis]) / key.Spacing[axis] - extent[2 * axis];
      double high = (planes[2 * axis + 1] - origin[axis]) / key.Spacing[axis] - extent[2 * axis];
      if (!(low <= high) || high < 0 || low > last)
      {
        return "the cropping box leaves nothing to draw";
      }
      key.Box[2 * axis] = static_cast<int>(std::max(0.0, std::floor(low)));
      key.Box[2 * axis + 1] = static_cast<int>(std::min(last, std::ceil(high)));
    }
  }
  reference = *std::min_element(key.Spacing.begin(), key.Spacing.end());
  for (int axis = 0; axis < 3; ++axis)
  {
    center[axis] = 0.5 * (key.Box[2 * axis] + key.Box[2 * axis + 1]) + (onCells ? 0.5 : 0.0);
  }
  if (this->Predictor && !(key != this->Volume))
  {
    return {};
  }

  const auto before = std::chrono::steady_clock::now();
  std::string failure = this->Internals->MakePredictor(*this);
  if (!failure.empty())
  {
    return failure;
  }
  double range[2];
  scalars->GetRange(range, key.Component);
  if (!std::isfinite(range[0]) || !std::isfinite(range[1]))
  {
    return "the scalars have no finite range";
  }
  if (!(static_cast<float>(range[1]) > static_cast<float>(range[0])))
  {
    range[1] = range[0] + std::max(1.0, std::fabs(range[0]));
  }
  entire::volume_desc desc;
  const std::size_t stride[3] = { static_cast<std::size_t>(components),
    static_cast<std::size_t>(components) * key.Dimensions[0],
    static_cast<std::size_t>(components) * key.Dimensions[0] * key.Dimensions[1] };
  std::size_t offset = static_cast<std::size_t>(key.Component);
  for (int axis = 0; axis < 3; ++axis)
  {
    offset += stride[axis] * key.Box[2 * axis];
    desc.strides[axis] = stride[axis];
    desc.dims[axis] = static_cast<std::size_t>(key.Box[2 * axis + 1] - key.Box[2 * axis] + 1);
    desc.spacing[axis] = static_cast<float>(key.Spacing[axis]);
  }
  desc.scalar_type = type;
  // The predictor keeps what it needs, so the voxels are only read here.
  const bool copied = type == ENTIRE_SCALAR_I8 || type == ENTIRE_SCALAR_U32 || type == ENTIRE_SCALAR_I32 ||
    type == ENTIRE_SCALAR_F64 || type == ENTIRE_SCALAR_U64 || type == ENTIRE_SCALAR_I64;
  desc.ownership = copied ? ENTIRE_VOXELS_COPY : ENTIRE_VOXELS_BORROW;
  desc.voxels = static_cast<const char*>(scalars->GetVoidPointer(0)) + offset * scalars->GetDataTypeSize();
  desc.voxel_count = voxels * components - offset;
  desc.range[0] = static_cast<float>(range[0]);
  desc.range[1] = static_cast<float>(range[1]);
  auto volume = entire::volume::create(desc);
  if (!volume)
  {
    return volume.message();
  }
  auto set = this->Predictor->set_volume(volume.value());
  if (!set)
  {
    return set.message();
  }
  this->Volume = key;
  this->Transfer = TransferKey();
  this->Range[0] = range[0];
  this->Range[1] = range[1];
  this->Internals->Clean = false;
  this->Internals->Owner->VolumeTime =
    std::chrono::duration<double>(std::chrono::steady_clock::now() - before).count();
  return {};
}

//------------------------------------------------------------------------------
// The eye as the library has it: relative to the volume's axes, lengths in the unit of the volume's spacing.
std::string vtkEntireSteering::vtkInternals::Leaf::SetCamera(
  entire::frame& frame, vtkImageData* image, const double center[3])
{
  vtkRenderer* renderer = this->Internals->Renderer;
  vtkCamera* camera = renderer->GetActiveCamera();
  double toEye[16];
  vtkMatrix4x4::Multiply4x4(camera->GetViewTransformMatrix()->GetData(),
    this->Internals->Volume->GetMatrix()->GetData(), toEye);
  const int* extent = image->GetExtent();
  const double index[3] = { center[0] + extent[0], center[1] + extent[2], center[2] + extent[4] };
  double world[3];
  vtkImageData::TransformContinuousIndexToPhysicalPoint(
    index[0], index[1], index[2], image->GetOrigin(), image->GetSpacing(), image->GetDirectionMatrix()->GetData(), world);
  const double* direction = image->GetDirectionMatrix()->GetData();
  double axes[3][3];
  double scales[3];
  for (int axis = 0; axis < 3; ++axis)
  {
    for (int row = 0; row < 3; ++row)
    {
      axes[axis][row] = 0;
      for (int k = 0; k < 3; ++k)
      {
        axes[axis][row] += toEye[4 * row + k] * direction[3 * k + axis];
      }
    }
    scales[axis] = vtkMath::Normalize(axes[axis]);
  }
  const double scale = std::cbrt(scales[0] * scales[1] * scales[2]);
  if (!(scale > 0) || !std::isfinite(scale))
  {
    return "the volume's matrix is singular";
  }
  if (std::fabs(vtkMath::Dot(axes[0], axes[1])) > 0.02 || std::fabs(vtkMath::Dot(axes[1], axes[2])) > 0.02 ||
    std::fabs(vtkMath::Dot(axes[2], axes[0])) > 0.02)
  {
    return "the volume's matrix shears the volume; rotations, translations and scales can be predicted";
  }
  // A rotation as exact as single precision needs; a mirrored volume counts as its mirror image.
  double across[3];
  vtkMath::Cross(axes[0], axes[1], across);
  vtkMath::Normalize(across);
  std::copy(across, across + 3, axes[2]);
  vtkMath::Cross(axes[2], axes[0], axes[1]);
  vtkMath::Normalize(axes[1]);

  double eye[3];
  for (int row = 0; row < 3; ++row)
  {
    eye[row] = toEye[4 * row + 3];
    for (int k = 0; k < 3; ++k)
    {
      eye[row] += toEye[4 * row + k] * world[k];
    }
    eye[row] /= scale;
  }
  const int* size = renderer->GetSize();
  double angle = camera->GetViewAngle();
  if (camera->GetUseHorizontalViewAngle())
  {
    angle = 2 *
      vtkMath::DegreesFromRadians(
        std::atan(std::tan(vtkMath::RadiansFromDegrees(0.5 * angle)) * size[1] / std::max(1, size[0])));
  }
  if (camera->GetParallelProjection())
  {
    // An eye far away that sees as much.
    angle = 2.0;
    eye[2] = -camera->GetParallelScale() / scale / std::tan(vtkMath::RadiansFromDegrees(0.5 * angle));
  }
  frame.fov_y = static_cast<float>(angle);
  frame.camera = ENTIRE_CAMERA_VIEW;
  for (int column = 0; column < 3; ++column)
  {
    for (int row = 0; row < 3; ++row)
    {
      frame.view[4 * column + row] = static_cast<float>(axes[column][row]);
    }
    frame.view[4 * column + 3] = 0;
    frame.view[12 + column] = static_cast<float>(eye[column]);
    frame.volume_center[column] = 0;
  }
  frame.view[15] = 1;

  // A jump of the camera is told; the library sees smooth motion by itself.
  if (this->HasView)
  {
    float turned = 0;
    for (int i = 0; i < 3; ++i)
    {
      turned = std::max(turned, std::fabs(frame.view[4 * i + 2] - this->LastView[4 * i + 2]));
    }
    const float ratio = frame.view[14] / this->LastView[14];
    if (turned > 0.5f || !(ratio > 0.67f && ratio < 1.5f))
    {
      static_cast<void>(this->Predictor->mark(ENTIRE_CHANGE_CAMERA));
    }
  }
  std::copy(frame.view, frame.view + 16, this->LastView);
  this->HasView = true;
  return {};
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::vtkInternals::Leaf::Prepare()
{
  vtkEntireSteering* owner = this->Internals->Owner;
  vtkRenderWindow* window = this->Internals->Window;
  vtkVolume* volume = this->Internals->Volume;
  vtkVolumeProperty* property = volume ? volume->GetProperty() : nullptr;
  if (!window || !property)
  {
    return "the renderer has no window or the volume no property";
  }
  vtkDataSet* input = this->Mapper->GetDataSetInput();
  vtkImageData* image = vtkImageData::SafeDownCast(input);
  if (!image)
  {
    return std::string("the mapper's input is ") + (input ? input->GetClassName() : "missing") +
      "; vtkImageData can be predicted";
  }
  std::string failure = this->Internals->MakePredictor(*this);
  if (!failure.empty())
  {
    return failure;
  }
  double center[3];
  double reference = 1;
  failure = this->SetVolume(image, property, center, reference);
  if (!failure.empty())
  {
    return failure;
  }
  TransferKey transfer;
  transfer.Property = property;
  transfer.Time = property->GetMTime();
  transfer.Range[0] = this->Range[0];
  transfer.Range[1] = this->Range[1];
  if (transfer != this->Transfer)
  {
    auto made = MakeTransferFunction(property, this->Range[0], this->Range[1]);
    if (!made)
    {
      return made.message();
    }
    auto unit = made.value().set_unit_distance(
      static_cast<float>(property->GetScalarOpacityUnitDistance(0)), ENTIRE_UNIT_WORLD);
    if (!unit)
    {
      return unit.message();
    }
    auto set = this->Predictor->set_transfer_function(made.value());
    if (!set)
    {
      return set.message();
    }
    this->Transfer = transfer;
  }

  const ModeKey mode{ { property->GetShade(0), property->GetInterpolationType(), this->Mapper->GetBlendMode(),
    property->HasGradientOpacity(0) && !property->GetDisableGradientOpacity(0) } };
  if (mode != this->Mode)
  {
    if (this->Mode[0] >= 0)
    {
      static_cast<void>(this->Predictor->mark(ENTIRE_CHANGE_MODE));
    }
    this->Mode = mode;
  }

  this->Own = Knobs::Read(this->Mapper);
  const bool gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(this->Mapper) != nullptr;
  const double rate = window->GetDesiredUpdateRate();
  const bool still = rate < owner->StillUpdateRate;
  // Where VTK adjusts by itself, the image sample distance that it left is that of an earlier frame.
  const double pixels = this->Own.AutoAdjust ? 1.0 : std::max(0.1f, this->Own.ImageSampleDistance);
  double finest = this->Own.SampleDistance;
  if (this->Own.Lock)
  {
    finest = SpacingMembers::Adjusted(this->Mapper, image->GetSpacing(), image->GetExtent());
  }
  finest = std::min(4096.0, std::max(1.0 / 64, finest / reference));

  const int* size = this->Internals->Renderer->GetSize();
  const auto shrunk = [&](int side, double by) {
    return static_cast<std::uint32_t>(std::min(16384.0, std::max(1.0, std::floor(side / by))));
  };
  entire::frame frame(shrunk(size[0], pixels), shrunk(size[1], pixels));
  failure = this->SetCamera(frame, image, center);
  if (!failure.empty())
  {
    return failure;
  }
  frame.shading = mode[0] ? ENTIRE_SHADING_LOCAL : ENTIRE_SHADING_NONE;
  frame.skipping = gpu ? ENTIRE_SKIPPING_NONE : ENTIRE_SKIPPING_BLOCKS;
  frame.termination = mode[2] == vtkVolumeMapper::COMPOSITE_BLEND ? (gpu ? 0.996f : 0.99f) : 1.0f;
  frame.step = static_cast<float>(finest);

  const double wanted = owner->TargetFrameTime > 0 ? owner->TargetFrameTime : 1.0 / std::max(rate, 1.0e-4);
  const double share =
    std::max(wanted - this->Internals->Rest(), LEAST_SHARE * wanted) / this->Internals->LeavesLastFrame;
  const float target = static_cast<float>(share);

  if (still || !owner->Enabled)
  {
    owner->SetReason(still ? "still" : "off");
    owner->SetStatus(still ? "a still frame, drawn by VTK alone" : "steering is off");
    // Learned from where it is known how finely VTK draws it.
    if (still || !this->Own.AutoAdjust)
    {
      static_cast<void>(this->Predictor->set_enabled(false));
      auto plan = this->Predictor->plan(frame, target);
      static_cast<void>(this->Predictor->set_enabled(true));
      if (plan)
      {
        this->Planned = plan.value();
        owner->SampleDistance = finest * reference;
        owner->ImageSampleDistance = pixels;
      }
    }
    return {};
  }

  if (owner->FinestSampleDistance > 0)
  {
    finest = std::max(1.0 / 64, owner->FinestSampleDistance);
  }
  const double coarsest = std::max(finest, owner->CoarsestSampleDistance);
  const double coarsestImage = std::max(pixels, owner->CoarsestImageSampleDistance);
  // Ray step and image are coarsened together: at equal cost that shows fewer differences from full quality than coarsening
  // one of them alone. The GPU mapper blurs any smaller image: there the step alone comes first.
  frame.step = static_cast<float>(finest);
  auto limits = this->Predictor->set_limits(static_cast<float>(finest), static_cast<float>(coarsest));
  if (!limits)
  {
    return limits.message();
  }
  auto sizes = this->Predictor->set_coarsest_pixel(
    static_cast<float>(std::min(64.0, coarsestImage / pixels)), gpu ? GPU_STEP_ALONE : 1.0f);
  if (!sizes)
  {
    return sizes.message();
  }
  auto planned = this->Predictor->plan(frame, target);
  if (!planned)
  {
    return planned.message();
  }
  this->Planned = planned.value();
  const double chosen = pixels * this->Planned.pixel;

  Knobs knobs;
  knobs.AutoAdjust = 0;
  knobs.Lock = 0;
  knobs.SampleDistance = static_cast<float>(this->Planned.step * reference);
  knobs.ImageSampleDistance = static_cast<float>(chosen);
  knobs.Write(this->Mapper);
  if (this->Outer && this->SetEarly())
  {
    this->OwnOuter = OuterKnobs::Read(this->Outer);
    OuterKnobs{ 0, 0, knobs.SampleDistance }.Write(this->Outer);
  }
  this->Steered = true;
  owner->SetReason(ReasonName(this->Planned.reason));
  owner->SetStatus("");
  owner->SampleDistance = knobs.SampleDistance;
  owner->ImageSampleDistance = chosen;
  return {};
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::ReadAhead()
{
  vtkVolume* volume = this->Internals->Volume;
  vtkImageData* image = vtkImageData::SafeDownCast(this->Mapper->GetDataSetInput());
  if (!image || !volume->GetProperty() || !this->Internals->MakePredictor(*this).empty())
  {
    return;
  }
  double center[3];
  double reference = 1;
  static_cast<void>(this->SetVolume(image, volume->GetProperty(), center, reference));
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::RendererStart()
{
  this->Ready = false;
  if (!this->SetEarly() || !this->Internals->Volume || !this->Internals->Volume->GetVisibility())
  {
    return;
  }
  if (this->Outer)
  {
    // Which of its mappers a smart mapper draws with is known from what it was told or did last.
    const int mode = this->Outer->GetRequestedRenderMode();
    if ((mode == vtkSmartVolumeMapper::DefaultRenderMode ? this->Outer->GetLastUsedRenderMode() : mode) !=
      vtkSmartVolumeMapper::RayCastRenderMode)
    {
      return;
    }
    if (!this->Mapper->GetDataSetInput())
    {
      // Its first frame connects it.
      return;
    }
  }
  else if (this->Mapper->GetInputAlgorithm())
  {
    this->Mapper->GetInputAlgorithm()->Update();
  }
  this->Plan();
  this->Ready = true;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Start()
{
  // Another renderer may draw the same mapper.
  if (!this->Internals->Rendering || !this->Internals->Renderer)
  {
    return;
  }
  if (!this->Ready)
  {
    if (this->SetEarly())
    {
      return;
    }
    this->Plan();
  }
  this->Ready = false;
  this->Drawing = true;
  vtkEntireSteering* owner = this->Internals->Owner;
  if (this->Steered)
  {
    owner->NumberOfSteeredFrames++;
  }
  else if (owner->Reason && !std::strcmp(owner->Reason, "fallback"))
  {
    owner->NumberOfFallbackFrames++;
  }
  this->StartTime = this->Internals->Now();
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Plan()
{
  const auto before = std::chrono::steady_clock::now();
  vtkEntireSteering* owner = this->Internals->Owner;
  this->Restore();
  this->Planned = {};
  const std::string failure = this->Prepare();
  if (!failure.empty())
  {
    this->Planned = {};
    if (!owner->Status || failure != owner->Status)
    {
      vtkWarningWithObjectMacro(owner, << "Not steered: " << failure);
    }
    owner->SetReason("fallback");
    owner->SetStatus(failure.c_str());
  }
  const bool known = this->Planned.id != 0;
  owner->PredictedTime = known && !(this->Planned.absent & ENTIRE_ABSENT_SECONDS) ? this->Planned.seconds : NOT_KNOWN;
  if (!known)
  {
    owner->SampleDistance = NOT_KNOWN;
    owner->ImageSampleDistance = NOT_KNOWN;
  }
  owner->ObserverTime = std::chrono::duration<double>(std::chrono::steady_clock::now() - before).count();
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::Restore()
{
  if (!this->Steered)
  {
    return;
  }
  this->Steered = false;
  if (this->Mapper)
  {
    this->Own.Write(this->Mapper);
  }
  if (this->Outer && this->SetEarly())
  {
    this->OwnOuter.Write(this->Outer);
  }
}

//------------------------------------------------------------------------------
void vtkEntireSteering::vtkInternals::Leaf::End()
{
  if (!this->Drawing)
  {
    return;
  }
  const double seconds = this->Internals->Now() - this->StartTime;
  const auto before = std::chrono::steady_clock::now();
  this->Drawing = false;
  if (!this->SetEarly())
  {
    this->Restore();
  }
  if (this->Planned.id != 0 && this->Predictor)
  {
    vtkRenderWindow* window = this->Internals->Window;
    const bool aborted = window && window->GetAbortRender();
    // A time that the library refuses teaches nothing.
    static_cast<void>(this->Predictor->observe(
      this->Planned.id, static_cast<float>(seconds), aborted ? ENTIRE_OBSERVE_CANCELLED : 0));
    this->Planned = {};
  }
  this->Internals->MapperSeconds += seconds;
  this->Internals->Drawn++;
  this->Internals->LastLeaf = this;
  this->Internals->Owner->ObserverTime +=
    std::chrono::duration<double>(std::chrono::steady_clock::now() - before).count();
}

//------------------------------------------------------------------------------
vtkEntireSteering::vtkEntireSteering()
  : PredictedTime(NOT_KNOWN)
  , MeasuredTime(NOT_KNOWN)
  , FrameTime(NOT_KNOWN)
  , SampleDistance(NOT_KNOWN)
  , ImageSampleDistance(NOT_KNOWN)
  , ObserverTime(NOT_KNOWN)
  , VolumeTime(NOT_KNOWN)
  , Internals(new vtkInternals(this))
{
  this->SetStatus("attached to nothing");
}

//------------------------------------------------------------------------------
vtkEntireSteering::~vtkEntireSteering()
{
  this->Internals.reset();
  this->SetModelFileName(nullptr);
  this->SetReason(nullptr);
  this->SetStatus(nullptr);
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::Attach(vtkRenderer* renderer, vtkVolume* volume)
{
  // What LoadState() was given before is for this attachment.
  std::vector<std::uint8_t> state;
  state.swap(this->Internals->State);
  this->Detach();
  state.swap(this->Internals->State);
  if (!renderer || !volume)
  {
    this->SetStatus("Attach() was given no renderer or no volume");
    vtkErrorMacro(<< this->Status);
    return false;
  }
  if (volume->GetMapper())
  {
    std::vector<Found> found;
    FindLeaves(volume->GetMapper(), found);
    if (found.empty() && !vtkMultiBlockVolumeMapper::SafeDownCast(volume->GetMapper()))
    {
      std::ostringstream text;
      text << volume->GetMapper()->GetClassName()
           << " cannot be steered; vtkFixedPointVolumeRayCastMapper, vtkGPUVolumeRayCastMapper, vtkSmartVolumeMapper and "
              "vtkMultiBlockVolumeMapper can";
      this->SetStatus(text.str().c_str());
      vtkErrorMacro(<< this->Status);
      return false;
    }
  }
  this->Internals->Volume = volume;
  this->Internals->Observe(renderer);
  this->Internals->FindMappers();
  this->Internals->LastClock = this->Clock;
  for (auto& leaf : this->Internals->Leaves)
  {
    leaf->ReadAhead();
  }
  this->SetStatus("no frame was drawn yet");
  this->Modified();
  return true;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::Detach()
{
  this->Internals->Release();
  this->Internals->State.clear();
  this->NumberOfSteeredFrames = 0;
  this->NumberOfFallbackFrames = 0;
  this->PredictedTime = this->MeasuredTime = this->FrameTime = NOT_KNOWN;
  this->SampleDistance = this->ImageSampleDistance = this->ObserverTime = this->VolumeTime = NOT_KNOWN;
  this->SetReason(nullptr);
  this->SetStatus("attached to nothing");
}

//------------------------------------------------------------------------------
vtkRenderer* vtkEntireSteering::GetRenderer()
{
  return this->Internals->Renderer;
}

//------------------------------------------------------------------------------
vtkVolume* vtkEntireSteering::GetVolume()
{
  return this->Internals->Volume;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::Reset()
{
  this->Internals->State.clear();
  for (auto& leaf : this->Internals->Leaves)
  {
    leaf->Forget();
  }
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::SaveState(const char* fileName)
{
  vtkInternals::Leaf* leaf = this->Internals->LastLeaf;
  if (!fileName || !leaf || !leaf->Predictor)
  {
    this->SetStatus(fileName ? "nothing was learned yet: no frame was drawn" : "SaveState() was given no file name");
    return false;
  }
  auto state = leaf->Predictor->save_state();
  if (!state)
  {
    this->SetStatus(state.message().c_str());
    return false;
  }
  const std::vector<std::uint8_t>& bytes = state.value();
  // Written aside and put in place whole: several ranks may save to one name at a time.
  const std::string aside = std::string(fileName) + ".part" +
    std::to_string(std::chrono::steady_clock::now().time_since_epoch().count() ^ reinterpret_cast<std::intptr_t>(this));
  std::ofstream file(aside, std::ios::binary | std::ios::trunc);
  file.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  file.close();
  if (!file || std::rename(aside.c_str(), fileName) != 0)
  {
    std::remove(aside.c_str());
    this->SetStatus((std::string(fileName) + " cannot be written").c_str());
    return false;
  }
  return true;
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::LoadState(const char* fileName)
{
  std::ifstream file(fileName ? fileName : "", std::ios::binary);
  if (!file)
  {
    this->SetStatus((std::string(fileName ? fileName : "(no name)") + " cannot be read").c_str());
    return false;
  }
  std::vector<std::uint8_t> bytes{ std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>() };
  // Tried on a predictor of its own first, so that a file that is no state changes nothing.
  auto trial = entire::predictor::untrained();
  if (!trial)
  {
    this->SetStatus(trial.message().c_str());
    return false;
  }
  auto loaded = trial.value().load_state(bytes);
  if (!loaded)
  {
    this->SetStatus((std::string(fileName) + ": " + loaded.message()).c_str());
    return false;
  }
  this->Internals->State = std::move(bytes);
  for (auto& leaf : this->Internals->Leaves)
  {
    leaf->Forget();
  }
  return true;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::PrintSelf(ostream& os, vtkIndent indent)
{
  this->Superclass::PrintSelf(os, indent);
  os << indent << "Renderer: " << this->GetRenderer() << "\n";
  os << indent << "Volume: " << this->GetVolume() << "\n";
  os << indent << "Enabled: " << this->Enabled << "\n";
  os << indent << "TargetFrameTime: " << this->TargetFrameTime << "\n";
  os << indent << "CoarsestSampleDistance: " << this->CoarsestSampleDistance << "\n";
  os << indent << "FinestSampleDistance: " << this->FinestSampleDistance << "\n";
  os << indent << "CoarsestImageSampleDistance: " << this->CoarsestImageSampleDistance << "\n";
  os << indent << "StillUpdateRate: " << this->StillUpdateRate << "\n";
  os << indent << "Clock: " << (this->Clock == WALL ? "wall" : "process CPU") << "\n";
  os << indent << "Tolerance: " << this->Tolerance << "\n";
  os << indent << "MissRate: " << this->MissRate << "\n";
  os << indent << "ModelFileName: " << (this->ModelFileName ? this->ModelFileName : "(none)") << "\n";
  os << indent << "PredictedTime: " << this->PredictedTime << "\n";
  os << indent << "MeasuredTime: " << this->MeasuredTime << "\n";
  os << indent << "FrameTime: " << this->FrameTime << "\n";
  os << indent << "SampleDistance: " << this->SampleDistance << "\n";
  os << indent << "ImageSampleDistance: " << this->ImageSampleDistance << "\n";
  os << indent << "ObserverTime: " << this->ObserverTime << "\n";
  os << indent << "VolumeTime: " << this->VolumeTime << "\n";
  os << indent << "Reason: " << (this->Reason ? this->Reason : "(none)") << "\n";
  os << indent << "Status: " << (this->Status ? this->Status : "(none)") << "\n";
  os << indent << "NumberOfSteeredFrames: " << this->NumberOfSteeredFrames << "\n";
  os << indent << "NumberOfFallbackFrames: " << this->NumberOfFallbackFrames << "\n";
}
