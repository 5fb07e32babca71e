// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireSteering.h"

#include "vtkEntireStateFile.h"
#include "vtkEntireSteeringInternals.h"

#include "vtkObjectFactory.h"
#include "vtkSmartPointer.h"

#include <sstream>
#include <string>
#include <utility>
#include <vector>

vtkStandardNewMacro(vtkEntireSteering);

using vtkEntire::NOT_KNOWN;

//------------------------------------------------------------------------------
vtkEntireSteering::vtkEntireSteering()
  : PredictedTime(NOT_KNOWN)
  , MeasuredTime(NOT_KNOWN)
  , FrameTime(NOT_KNOWN)
  , ShareTime(NOT_KNOWN)
  , SampleDistance(NOT_KNOWN)
  , ImageSampleDistance(NOT_KNOWN)
  , ObserverTime(NOT_KNOWN)
  , VolumeTime(NOT_KNOWN)
  , Internals(new vtkInternals(this))
{
  this->Internals->Report(nullptr, "attached to nothing");
}

//------------------------------------------------------------------------------
vtkEntireSteering::~vtkEntireSteering()
{
  this->Internals.reset();
  this->SetModelFileName(nullptr);
  delete[] this->Reason;
  delete[] this->Status;
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::CanSteer(vtkAbstractVolumeMapper* mapper)
{
  return vtkEntire::Refusal(mapper).empty();
}

//------------------------------------------------------------------------------
std::string vtkEntireSteering::GetRefusal(vtkAbstractVolumeMapper* mapper)
{
  return vtkEntire::Refusal(mapper);
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::Fail(const std::string& text)
{
  // An observer of the error may drop the last reference to this object.
  const vtkSmartPointer<vtkEntireSteering> self(this);
  this->Internals->Report(nullptr, text.c_str());
  vtkErrorMacro(<< text);
  return false;
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::Attach(vtkRenderer* renderer, vtkVolume* volume)
{
  const vtkSmartPointer<vtkEntireSteering> self(this);
  // Detach() clears the state. A state that LoadState() read before this call is kept for the new attachment.
  std::vector<std::uint8_t> state;
  state.swap(this->Internals->State);
  this->Detach();
  // Observers that Detach() invoked may have attached again.
  vtkInternals::ReleaseAll(this->Internals->TakeApart());
  state.swap(this->Internals->State);
  if (!renderer || !volume)
  {
    return this->Fail("Attach() was given no renderer or no volume");
  }
  // The volume may get its mapper later.
  const std::string refusal = volume->GetMapper() ? GetRefusal(volume->GetMapper()) : std::string();
  if (!refusal.empty())
  {
    return this->Fail(refusal);
  }
  this->Internals->Volume = volume;
  this->Internals->LastClock = this->Clock;
  this->Internals->Observe(renderer);
  this->Internals->FindMappers();
  const vtkInternals::Leaves leaves = this->Internals->Drawing;
  for (const auto& leaf : leaves)
  {
    leaf->ReadAhead();
  }
  this->Internals->Report(nullptr, ("no frame was drawn yet; " + this->Internals->ClocksText()).c_str());
  this->Modified();
  return true;
}

//------------------------------------------------------------------------------
void vtkEntireSteering::Detach()
{
  const vtkSmartPointer<vtkEntireSteering> self(this);
  const vtkInternals::Leaves leaves = this->Internals->TakeApart();
  this->Internals->State.clear();
  this->NumberOfSteeredFrames = 0;
  this->NumberOfFallbackFrames = 0;
  this->NumberOfVolumeReadings = 0;
  this->NumberOfTransferFunctionReadings = 0;
  this->PredictedTime = this->MeasuredTime = this->FrameTime = this->ShareTime = NOT_KNOWN;
  this->SampleDistance = this->ImageSampleDistance = this->ObserverTime = this->VolumeTime = NOT_KNOWN;
  delete[] this->Reason;
  this->Reason = nullptr;
  this->Internals->Report(nullptr, "attached to nothing");
  // Last, since this may invoke observers.
  vtkInternals::ReleaseAll(leaves);
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
const char* vtkEntireSteering::GetModelClock()
{
  return this->Internals->ModelClockName();
}

//------------------------------------------------------------------------------
void vtkEntireSteering::Reset()
{
  this->Internals->State.clear();
  this->Internals->RefusedModel.clear();
  this->Internals->Model.reset();
  for (const auto& leaf : this->Internals->Drawing)
  {
    leaf->Forget();
  }
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::SaveState(const char* fileName)
{
  const std::shared_ptr<vtkInternals::Leaf> leaf = this->Internals->LastLeaf.lock();
  if (!fileName || !*fileName)
  {
    return this->Fail("SaveState() was given no file name");
  }
  if (!leaf || !leaf->Session)
  {
    return this->Fail("nothing was learned yet: no frame was drawn");
  }
  auto state = leaf->Session->save_state();
  if (!state)
  {
    return this->Fail(state.message());
  }
  const std::string failure = vtkEntire::WriteStateFile(fileName, state.value());
  return failure.empty() || this->Fail(failure);
}

//------------------------------------------------------------------------------
bool vtkEntireSteering::LoadState(const char* fileName)
{
  if (!fileName || !*fileName)
  {
    return this->Fail("LoadState() was given no file name");
  }
  std::vector<std::uint8_t> bytes;
  std::string failure = vtkEntire::ReadStateFile(fileName, bytes);
  if (!failure.empty())
  {
    return this->Fail(failure);
  }
  // Tries the bytes on a separate session first, so that an invalid file changes nothing.
  failure = this->Internals->Try(bytes);
  if (!failure.empty())
  {
    return this->Fail(std::string(fileName) + ": " + failure);
  }
  this->Internals->State = std::move(bytes);
  for (const auto& leaf : this->Internals->Drawing)
  {
    // A session that accepts the state keeps its volume, so that the voxels are not read again.
    if (leaf->Session && leaf->Session->load_state(this->Internals->State))
    {
      leaf->RefusedState = false;
    }
    else
    {
      leaf->Forget();
    }
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
  for (const auto& each : { std::make_pair("FixedPointQuality: ", this->FixedPointQuality),
         std::make_pair("GPUQuality: ", this->GPUQuality) })
  {
    const double* q = each.second;
    os << indent << each.first << q[0] << " " << q[1] << " " << q[2] << " " << q[3] << "\n";
  }
  os << indent << "StillUpdateRate: " << this->StillUpdateRate << "\n";
  os << indent << "Clock: " << this->Internals->ClockName() << "\n";
  os << indent << "Tolerance: " << this->Tolerance << "\n";
  os << indent << "MissRate: " << this->MissRate << "\n";
  os << indent << "IgnoreLoad: " << this->IgnoreLoad << "\n";
  os << indent << "ModelFileName: " << (this->ModelFileName ? this->ModelFileName : "(none)") << "\n";
  os << indent << "ModelClock: " << (this->GetModelClock() ? this->GetModelClock() : "(not stated)") << "\n";
  os << indent << "PredictedTime: " << this->PredictedTime << "\n";
  os << indent << "MeasuredTime: " << this->MeasuredTime << "\n";
  os << indent << "FrameTime: " << this->FrameTime << "\n";
  os << indent << "ShareTime: " << this->ShareTime << "\n";
  os << indent << "SampleDistance: " << this->SampleDistance << "\n";
  os << indent << "ImageSampleDistance: " << this->ImageSampleDistance << "\n";
  os << indent << "ObserverTime: " << this->ObserverTime << "\n";
  os << indent << "VolumeTime: " << this->VolumeTime << "\n";
  os << indent << "Reason: " << (this->Reason ? this->Reason : "(none)") << "\n";
  os << indent << "Status: " << (this->Status ? this->Status : "(none)") << "\n";
  os << indent << "NumberOfSteeredFrames: " << this->NumberOfSteeredFrames << "\n";
  os << indent << "NumberOfFallbackFrames: " << this->NumberOfFallbackFrames << "\n";
  os << indent << "NumberOfVolumeReadings: " << this->NumberOfVolumeReadings << "\n";
  os << indent << "NumberOfTransferFunctionReadings: " << this->NumberOfTransferFunctionReadings << "\n";
}
