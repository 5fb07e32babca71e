// SPDX-License-Identifier: MIT OR Apache-2.0
// Tests of array layouts and render modes that not every version of VTK has: TestModes NAME MAPPER. A test of a
// feature that this version lacks is skipped and prints the reason.
#include "Scene.h"

#include "vtkEntireSteering.h"
#include "vtkPointData.h"
#include "vtkSOADataArrayTemplate.h"
#include "vtkTestErrorObserver.h"
#include "vtkVersion.h"

#include <fstream>

using namespace EntireTest;

namespace
{
// Ends the test with the status that CMakeLists.txt names; the reason goes to the file that ENTIRE_TEST_SKIPS names.
[[noreturn]] void Skip(const std::string& what)
{
  const std::string reason = std::string("VTK ") + vtkVersion::GetVTKVersion() + " has no " + what;
  std::cout << "skipped: " << reason << "\n";
  if (const char* file = std::getenv("ENTIRE_TEST_SKIPS"))
  {
    std::ofstream(file, std::ios::app) << reason << "\n";
  }
  std::exit(77);
}

// These functions set properties that only newer versions of VTK have; they return false if this version lacks the
// property.
template <class Mapper>
auto DrawByAnari(Mapper* smart, int) -> decltype(smart->SetRequestedRenderMode(Mapper::AnariRenderMode), true)
{
  smart->SetRequestedRenderMode(Mapper::AnariRenderMode);
  return true;
}
template <class Mapper>
bool DrawByAnari(Mapper*, long)
{
  return false;
}

template <class Mapper>
auto Jitter(Mapper* mapper, int) -> decltype(mapper->SetUseJittering(1), true)
{
  mapper->SetUseJittering(1);
  return true;
}
template <class Mapper>
bool Jitter(Mapper*, long)
{
  return false;
}

template <class Mapper>
auto Resample(Mapper* smart, int) -> decltype(smart->SetLowResMode(Mapper::LowResModeResample), true)
{
  smart->SetLowResMode(Mapper::LowResModeResample);
  return true;
}
template <class Mapper>
bool Resample(Mapper*, long)
{
  return false;
}

void SetMode(Scene& scene, Kind kind, int mode)
{
  if (kind == BLOCKS)
  {
    vtkMultiBlockVolumeMapper::SafeDownCast(scene.Mapper)->SetRequestedRenderMode(mode);
  }
  else
  {
    vtkSmartVolumeMapper::SafeDownCast(scene.Mapper)->SetRequestedRenderMode(mode);
  }
}

// A mode that draws outside of VTK's mappers is refused, also if it is set while frames are steered. The text of the
// refusal names the mode.
void Refuses(Kind kind, int mode, const char* name)
{
  Scene scene(kind);
  const int own =
    kind == SMART_FIXED ? vtkSmartVolumeMapper::RayCastRenderMode : vtkSmartVolumeMapper::GPURenderMode;
  vtkNew<vtkEntireSteering> steering;
  vtkNew<vtkTest::ErrorObserver> said;
  steering->AddObserver(vtkCommand::ErrorEvent, said);
  steering->AddObserver(vtkCommand::WarningEvent, said);
  steering->SetTargetFrameTime(1e-6);
  CHECK(vtkEntireSteering::CanSteer(scene.Mapper) && vtkEntireSteering::GetRefusal(scene.Mapper).empty());
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  scene.Interactive();
  scene.Draw(3);
  const vtkIdType steered = steering->GetNumberOfSteeredFrames();
  CHECK(steered > 0 && !said->GetWarning());
  SetMode(scene, kind, mode);
  CHECK(!vtkEntireSteering::CanSteer(scene.Mapper));
  CHECK(Says(vtkEntireSteering::GetRefusal(scene.Mapper).c_str(), name));
  scene.Draw();
  CHECK(steering->GetNumberOfSteeredFrames() == steered);
  CHECK(Is(steering->GetReason(), "fallback") && Says(steering->GetStatus(), name));
  CHECK(std::isnan(steering->GetPredictedTime()) && std::isnan(steering->GetSampleDistance()));
  CHECK(said->GetWarning() && Says(said->GetWarningMessage().c_str(), name));
  said->Clear();
  scene.Draw();
  CHECK(!said->GetWarning());
  vtkNew<vtkEntireSteering> late;
  late->AddObserver(vtkCommand::ErrorEvent, said);
  CHECK(!late->Attach(scene.Renderer, scene.Volume) && Says(late->GetStatus(), name));
  CHECK(said->GetError() && !late->GetVolume());
  SetMode(scene, kind, own);
  CHECK(vtkEntireSteering::CanSteer(scene.Mapper));
  scene.Draw(2);
  CHECK(steering->GetNumberOfSteeredFrames() > steered && Empty(steering->GetStatus()));
}

void RefusesOSPRay(Kind kind)
{
  Refuses(kind, vtkSmartVolumeMapper::OSPRayRenderMode, "OSPRay");
}

void RefusesAnari(Kind kind)
{
  vtkNew<vtkSmartVolumeMapper> smart;
  if (!DrawByAnari(smart.GetPointer(), 0))
  {
    Skip("render mode by ANARI");
  }
  Refuses(kind, smart->GetRequestedRenderMode(), "ANARI");
}

// Scalars in a structure of arrays give the same prediction as contiguous ones, and are not copied as a whole.
void ReadsScalarsOfAnyLayout(Kind kind)
{
  const char* const model = std::getenv("ENTIRE_TEST_MODEL");
  CHECK(model);
  double predicted[2];
  for (int apart = 0; apart < 2; ++apart)
  {
    Scene scene(kind);
    vtkNew<vtkTest::ErrorObserver> copies;
    if (apart)
    {
      vtkDataArray* const together = scene.Data->GetPointData()->GetScalars();
      vtkNew<vtkSOADataArrayTemplate<unsigned char>> values;
      values->DeepCopy(together);
      CHECK(!values->HasStandardMemoryLayout());
      values->AddObserver(vtkCommand::WarningEvent, copies);
      scene.Data->GetPointData()->SetScalars(values);
    }
    vtkNew<vtkEntireSteering> steering;
    steering->SetTargetFrameTime(1e-6);
    steering->SetModelFileName(model);
    CHECK(steering->Attach(scene.Renderer, scene.Volume));
    // A smart mapper is read in its first frame, in which VTK itself asks for a copy.
    CHECK(steering->GetNumberOfVolumeReadings() == (kind == SMART ? 0 : 1) && !copies->GetWarning());
    scene.Interactive();
    scene.Draw();
    CHECK(steering->GetNumberOfVolumeReadings() == 1 && steering->GetNumberOfSteeredFrames() == 1);
    predicted[apart] = steering->GetPredictedTime();
  }
  CHECK(predicted[0] > 0 && predicted[0] == predicted[1]);
}

// Frames with jittered ray starts are steered, and equal those that VTK draws with the same sample distances.
void DrawsWithJitter(Kind kind)
{
  Scene plain(GPU), steered(kind);
  const bool can = kind == GPU
    ? Jitter(vtkGPUVolumeRayCastMapper::SafeDownCast(steered.Mapper), 0)
    : Jitter(vtkSmartVolumeMapper::SafeDownCast(steered.Mapper), 0);
  if (!can)
  {
    Skip("jittering in vtkSmartVolumeMapper");
  }
  auto* const mapper = vtkGPUVolumeRayCastMapper::SafeDownCast(plain.Mapper);
  mapper->SetAutoAdjustSampleDistances(0);
  mapper->SetLockSampleDistanceToInputSpacing(0);
  vtkNew<vtkEntireSteering> steering;
  steering->SetTargetFrameTime(1e-6);
  steering->SetCoarsestImageSampleDistance(1);
  CHECK(steering->Attach(steered.Renderer, steered.Volume));
  plain.Interactive();
  steered.Interactive();
  const auto shown = steered.Draw(4);
  mapper->SetSampleDistance(static_cast<float>(steering->GetSampleDistance()));
  const auto smooth = plain.Draw();
  CHECK(Jitter(mapper, 0));
  CHECK(plain.Draw(2) == shown && smooth != shown);
  CHECK(steering->GetNumberOfFallbackFrames() == 0 && Empty(steering->GetStatus()));
}

// If a volume does not fit into the device's memory, a smart mapper draws a resampled volume, and frames are planned
// from that volume.
void SteersResampledVolumes(Kind kind)
{
  Scene plain(kind), scene(kind);
  for (Scene* each : { &plain, &scene })
  {
    auto* const smart = vtkSmartVolumeMapper::SafeDownCast(each->Mapper);
    if (!Resample(smart, 0))
    {
      Skip("low-resolution mode in vtkSmartVolumeMapper");
    }
    smart->SetMaxMemoryInBytes(EDGE * EDGE * EDGE / 8);
    smart->SetMaxMemoryFraction(1.0f);
  }
  vtkNew<vtkEntireSteering> steering;
  steering->SetTargetFrameTime(1000);
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  plain.Window->SetDesiredUpdateRate(0.0001);
  scene.Window->SetDesiredUpdateRate(0.0001);
  plain.Draw();
  scene.Draw();
  CHECK(plain.Draw() == scene.Draw() && Is(steering->GetReason(), "still"));
  scene.Interactive();
  scene.Draw(2);
  const double fine = steering->GetSampleDistance();
  CHECK(Is(steering->GetReason(), "finest allowed") && Empty(steering->GetStatus()) && fine > 0);
  steering->SetTargetFrameTime(1e-6);
  scene.Draw(2);
  // The coarsest sample distance is 8 voxel spacings of the resampled volume, whose spacing is larger than 1.
  CHECK(Is(steering->GetReason(), "target unreachable") && steering->GetSampleDistance() > 8.5);
  CHECK(steering->GetNumberOfFallbackFrames() == 0);
}

const std::map<std::string, std::function<void(Kind)>> TESTS = {
  { "RefusesOSPRay", RefusesOSPRay },
  { "RefusesAnari", RefusesAnari },
  { "ReadsScalarsOfAnyLayout", ReadsScalarsOfAnyLayout },
  { "DrawsWithJitter", DrawsWithJitter },
  { "SteersResampledVolumes", SteersResampledVolumes },
};
}

int main(int argc, char* argv[])
{
  return Main(argc, argv, TESTS);
}
