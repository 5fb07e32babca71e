// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireViewSteering.h"

#include "vtkCommand.h"
#include "vtkEntireSteering.h"
#include "vtkObjectFactory.h"
#include "vtkPVRenderView.h"
#include "vtkProcessModule.h"
#include "vtkPropCollection.h"
#include "vtkRenderer.h"
#include "vtkSmartPointer.h"
#include "vtkVolume.h"
#include "vtkWeakPointer.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <utility>
#include <vector>

vtkStandardNewMacro(vtkEntireViewSteering);

namespace
{
constexpr double NOT_KNOWN = std::numeric_limits<double>::quiet_NaN();
}

class vtkEntireViewSteering::vtkInternals
{
public:
  explicit vtkInternals(vtkEntireViewSteering* owner)
    : Owner(owner)
  {
  }
  ~vtkInternals() { this->Release(); }

  void Release()
  {
    if (this->Renderer)
    {
      this->Renderer->RemoveObserver(this->Tag);
    }
    this->Renderer = nullptr;
    // Moved out of the member first, since the deletion of a vtkEntireSteering may invoke observers.
    const auto volumes = std::move(this->Volumes);
    this->Volumes.clear();
  }

  void Take(vtkRenderer* renderer)
  {
    this->Release();
    this->Renderer = renderer;
    if (renderer)
    {
      // The priority makes this observer run before those of each vtkEntireSteering.
      this->Tag = renderer->AddObserver(vtkCommand::StartEvent, this, &vtkInternals::Start, 2.0f);
    }
  }

  // Attaches a steering to each volume that the view draws and that has none yet, and passes on the settings.
  void Start()
  {
    // An observer of an error that is reported here may release this object.
    const vtkSmartPointer<vtkEntireViewSteering> owner(this->Owner);
    const vtkSmartPointer<vtkRenderer> renderer(this->Renderer);
    vtkPropCollection* props = renderer ? renderer->GetViewProps() : nullptr;
    if (!props)
    {
      return;
    }
    std::vector<vtkSmartPointer<vtkVolume>> drawn;
    vtkCollectionSimpleIterator at;
    props->InitTraversal(at);
    while (vtkProp* prop = props->GetNextProp(at))
    {
      vtkVolume* volume = vtkVolume::SafeDownCast(prop);
      // A mapper that cannot be steered (an unstructured grid's) is left to ParaView.
      if (volume && volume->GetVisibility() && vtkEntireSteering::CanSteer(volume->GetMapper()))
      {
        drawn.emplace_back(volume);
      }
    }
    this->Volumes.erase(std::remove_if(this->Volumes.begin(), this->Volumes.end(),
                          [](const vtkSmartPointer<vtkEntireSteering>& each) { return !each->GetVolume(); }),
      this->Volumes.end());
    for (const auto& volume : drawn)
    {
      auto is = [&](const vtkSmartPointer<vtkEntireSteering>& each) { return each->GetVolume() == volume; };
      if (std::any_of(this->Volumes.begin(), this->Volumes.end(), is))
      {
        continue;
      }
      auto steering = vtkSmartPointer<vtkEntireSteering>::New();
      // Set before Attach(), which reads the volume: a later change of clock, model or state would read it again.
      this->Configure(steering);
      if (owner->StateFileName && *owner->StateFileName && this->Draws())
      {
        // The steering reports an error in the file.
        static_cast<void>(steering->LoadState(owner->StateFileName));
      }
      if (steering->Attach(renderer, volume))
      {
        this->Volumes.push_back(steering);
      }
      if (this->Renderer.GetPointer() != renderer)
      {
        return;
      }
    }
    const auto volumes = this->Volumes;
    for (const auto& each : volumes)
    {
      this->Configure(each);
    }
  }

  void Configure(vtkEntireSteering* steering)
  {
    steering->SetEnabled(this->Owner->Enabled);
    steering->SetTargetFrameTime(this->Owner->TargetFrameTime);
    steering->SetCoarsestSampleDistance(this->Owner->CoarsestSampleDistance);
    steering->SetCoarsestImageSampleDistance(this->Owner->CoarsestImageSampleDistance);
    steering->SetClock(this->Owner->Clock);
    const char* model = this->Owner->ModelFileName;
    steering->SetModelFileName(model && *model ? model : nullptr);
  }

  // True if this process draws the view's volumes, by the rule of vtkPVRenderView: with distributed rendering the
  // servers and all ranks draw, else the client or the first rank.
  bool Draws() const
  {
    if (!this->View)
    {
      return true;
    }
    const auto process = vtkProcessModule::GetProcessType();
    if (this->View->GetUseDistributedRenderingForRender())
    {
      return process != vtkProcessModule::PROCESS_CLIENT;
    }
    return process == vtkProcessModule::PROCESS_CLIENT ||
      (process == vtkProcessModule::PROCESS_BATCH && IsFirstRank());
  }

  static bool IsFirstRank() { return vtkProcessModule::GetProcessModule()->GetPartitionId() == 0; }

  // Returns the internals whose values the getters return: those of the source if it is set, else this object.
  vtkInternals& Read() { return this->Source ? *this->Source->Internals : *this; }

  // Returns the steering of the visible volume that took longest in its last frame; nullptr without visible volumes.
  vtkEntireSteering* Last()
  {
    if (this->Source)
    {
      return this->Source->Internals->Last();
    }
    vtkEntireSteering* last = nullptr;
    for (auto& each : this->Volumes)
    {
      vtkVolume* const volume = each->GetVolume();
      if (!volume || !volume->GetVisibility() || !this->Renderer || !this->Renderer->HasViewProp(volume))
      {
        continue;
      }
      // The time of a volume that was never drawn is NaN.
      const bool longer = last && each->GetMeasuredTime() > last->GetMeasuredTime();
      const bool drawn = !last || !std::isnan(last->GetMeasuredTime());
      if (!last || longer || !drawn)
      {
        last = each;
      }
    }
    return last;
  }

  vtkEntireViewSteering* Owner;
  vtkWeakPointer<vtkEntireViewSteering> Source;
  vtkWeakPointer<vtkPVRenderView> View;
  vtkWeakPointer<vtkRenderer> Renderer;
  unsigned long Tag = 0;
  std::vector<vtkSmartPointer<vtkEntireSteering>> Volumes;
};

//------------------------------------------------------------------------------
vtkEntireViewSteering::vtkEntireViewSteering()
  : Internals(new vtkInternals(this))
{
}

//------------------------------------------------------------------------------
vtkEntireViewSteering::~vtkEntireViewSteering()
{
  this->Internals.reset();
  this->SetModelFileName(nullptr);
  delete[] this->StateFileName;
}

//------------------------------------------------------------------------------
void vtkEntireViewSteering::SetView(vtkPVRenderView* view)
{
  this->Internals->View = view;
  vtkRenderer* renderer = view ? view->GetRenderer() : nullptr;
  if (renderer != this->Internals->Renderer)
  {
    this->Internals->Take(renderer);
    this->Modified();
  }
}

//------------------------------------------------------------------------------
void vtkEntireViewSteering::SetSource(vtkEntireViewSteering* source)
{
  // A source that has a source itself could make a cycle.
  this->Internals->Source = source && source != this && !source->Internals->Source ? source : nullptr;
}

//------------------------------------------------------------------------------
void vtkEntireViewSteering::SetStateFileName(const char* fileName)
{
  const vtkSmartPointer<vtkEntireViewSteering> self(this);
  const std::string before = this->StateFileName ? this->StateFileName : "";
  if (before == (fileName ? fileName : ""))
  {
    return;
  }
  delete[] this->StateFileName;
  this->StateFileName = nullptr;
  if (fileName && *fileName)
  {
    this->StateFileName = new char[std::string(fileName).size() + 1];
    std::copy(fileName, fileName + std::string(fileName).size() + 1, this->StateFileName);
    const std::string name = this->StateFileName;
    // Every process gets the name, but the file is on the disk of the process that draws.
    if (this->Internals->Draws())
    {
      const auto volumes = this->Internals->Volumes;
      for (const auto& each : volumes)
      {
        // The steering reports an error in the file.
        static_cast<void>(each->LoadState(name.c_str()));
      }
    }
  }
  this->Modified();
}

//------------------------------------------------------------------------------
bool vtkEntireViewSteering::SaveState(const char* fileName)
{
  if (!fileName || !*fileName)
  {
    return false;
  }
  // Every process gets the name, but one writes the file.
  if (!this->Internals->Draws() || !vtkInternals::IsFirstRank())
  {
    return true;
  }
  const vtkSmartPointer<vtkEntireSteering> last(this->Internals->Last());
  if (!last)
  {
    vtkErrorMacro("nothing was learned yet: no volume is visible");
    return false;
  }
  return last->SaveState(fileName);
}

//------------------------------------------------------------------------------
void vtkEntireViewSteering::Reset()
{
  for (auto& each : this->Internals->Volumes)
  {
    each->Reset();
  }
}

//------------------------------------------------------------------------------
#define ENTIRE_LAST_VALUE(name) \
  double vtkEntireViewSteering::Get##name() \
  { \
    vtkEntireSteering* last = this->Internals->Last(); \
    return last ? last->Get##name() : NOT_KNOWN; \
  }
ENTIRE_LAST_VALUE(PredictedTime)
ENTIRE_LAST_VALUE(MeasuredTime)
ENTIRE_LAST_VALUE(FrameTime)
ENTIRE_LAST_VALUE(SampleDistance)
ENTIRE_LAST_VALUE(ImageSampleDistance)
ENTIRE_LAST_VALUE(ObserverTime)
#undef ENTIRE_LAST_VALUE
const char* vtkEntireViewSteering::GetReason()
{
  vtkEntireSteering* last = this->Internals->Last();
  return last && last->GetReason() ? last->GetReason() : "";
}
const char* vtkEntireViewSteering::GetStatus()
{
  vtkEntireSteering* last = this->Internals->Last();
  if (!last)
  {
    return "no volume is drawn";
  }
  return last->GetStatus() ? last->GetStatus() : "";
}
vtkIdType vtkEntireViewSteering::GetNumberOfSteeredFrames()
{
  vtkIdType sum = 0;
  for (auto& each : this->Internals->Read().Volumes)
  {
    sum += each->GetNumberOfSteeredFrames();
  }
  return sum;
}
vtkIdType vtkEntireViewSteering::GetNumberOfFallbackFrames()
{
  vtkIdType sum = 0;
  for (auto& each : this->Internals->Read().Volumes)
  {
    sum += each->GetNumberOfFallbackFrames();
  }
  return sum;
}

//------------------------------------------------------------------------------
void vtkEntireViewSteering::PrintSelf(ostream& os, vtkIndent indent)
{
  this->Superclass::PrintSelf(os, indent);
  os << indent << "Enabled: " << this->Enabled << "\n";
  os << indent << "TargetFrameTime: " << this->TargetFrameTime << "\n";
  os << indent << "CoarsestSampleDistance: " << this->CoarsestSampleDistance << "\n";
  os << indent << "CoarsestImageSampleDistance: " << this->CoarsestImageSampleDistance << "\n";
  os << indent << "Clock: " << this->Clock << "\n";
  os << indent << "ModelFileName: " << (this->ModelFileName ? this->ModelFileName : "(none)") << "\n";
  os << indent << "StateFileName: " << (this->StateFileName ? this->StateFileName : "(none)") << "\n";
  for (auto& each : this->Internals->Volumes)
  {
    each->PrintSelf(os, indent.GetNextIndent());
  }
}
