// SPDX-License-Identifier: MIT OR Apache-2.0
// Tests of how vtkEntireSteering detects changes, frames and frame times: TestFollowing NAME MAPPER.
#include "Scene.h"

#include "vtkActor.h"
#include "vtkAssembly.h"
#include "vtkAssemblyPaths.h"
#include "vtkDataArray.h"
#include "vtkDataObject.h"
#include "vtkDoubleArray.h"
#include "vtkEntireSteering.h"
#include "vtkHardwareSelector.h"
#include "vtkObjectFactory.h"
#include "vtkPointData.h"
#include "vtkSelection.h"
#include "vtkTestErrorObserver.h"

#include <cstdio>
#include <fstream>
#include <iterator>
#include <sstream>

// Last, since X11's headers define macros that break other headers.
#include "vtkXOpenGLRenderWindow.h"

using namespace EntireTest;

namespace
{
// A steered scene after its first frames.
struct Work : Scene
{
  vtkNew<vtkEntireSteering> Steering;

  explicit Work(Kind kind, double target = 1e-6)
    : Scene(kind)
  {
    this->Steering->SetTargetFrameTime(target);
    CHECK(this->Steering->Attach(this->Renderer, this->Volume));
    this->Interactive();
    this->Draw(4);
    CHECK(this->Steering->GetNumberOfSteeredFrames() > 1);
  }
};

std::string Bytes(const std::string& file)
{
  std::ifstream stream(file, std::ios::binary);
  return { std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>() };
}

// Voxels that are changed in place are read again only if the image reports the change.
void NoticesChangedVoxels(Kind kind)
{
  Work scene(kind);
  const vtkIdType before = scene.Steering->GetNumberOfVolumeReadings();
  CHECK(before > 0);
  scene.Pose(70);
  scene.Draw();
  scene.Property->ShadeOn();
  scene.Draw();
  CHECK(scene.Steering->GetNumberOfVolumeReadings() == before);
  std::memset(scene.Data->GetScalarPointer(), 40, EDGE * EDGE * EDGE / 2);
  scene.Data->Modified();
  if (kind == BLOCKS)
  {
    // vtkMultiBlockVolumeMapper draws copies of its blocks, and ignores the blocks' own times.
    scene.Data->GetPointData()->GetScalars()->Modified();
  }
  scene.Draw();
  // The time to read the voxels is part of ObserverTime.
  CHECK(scene.Steering->GetNumberOfVolumeReadings() == before + 1);
  CHECK(scene.Steering->GetObserverTime() >= scene.Steering->GetVolumeTime());
  scene.Draw();
  CHECK(scene.Steering->GetNumberOfVolumeReadings() == before + 1);
}

// The transfer function is read again only if its nodes or unit distance change, not for other changes of the property.
void NoticesNewFunctionsOnly(Kind kind)
{
  Work scene(kind);
  vtkIdType expected = scene.Steering->GetNumberOfTransferFunctionReadings();
  CHECK(expected > 0);
  const auto readings = [&] {
    scene.Draw();
    return scene.Steering->GetNumberOfTransferFunctionReadings();
  };
  scene.Property->SetAmbient(0.37);
  CHECK(readings() == expected);
  scene.Property->SetInterpolationTypeToNearest();
  CHECK(readings() == expected);
  scene.Property->ShadeOn();
  CHECK(readings() == expected);
  scene.Opacity->Modified();
  CHECK(readings() == expected);
  scene.Opacity->AddPoint(120, 0.7, 0.9, 0.8);
  CHECK(readings() == ++expected);
  scene.Color->AddRGBPoint(100, 0.2, 0.9, 0.2);
  CHECK(readings() == ++expected);
  scene.Property->SetScalarOpacityUnitDistance(3.5);
  CHECK(readings() == ++expected);
  scene.Opacity->UseLogScaleOn();
  CHECK(readings() == ++expected);
  CHECK(readings() == expected);
}

// A drawing for a hardware selector is not steered and does not count as a frame, and its time is not observed.
void LeavesPickingAlone(Kind kind)
{
  Work scene(kind);
  if (auto* cpu = vtkFixedPointVolumeRayCastMapper::SafeDownCast(scene.Mapper))
  {
    // With AutoAdjustSampleDistances, the fixed-point mapper sets coarse distances itself.
    cpu->AutoAdjustSampleDistancesOff();
    scene.Draw();
  }
  const std::string base = std::getenv("ENTIRE_TEST_FILE");
  const std::string before = base + ".before", after = base + ".after", later = base + ".later";
  const vtkIdType steered = scene.Steering->GetNumberOfSteeredFrames();
  CHECK(scene.Steering->SaveState(before.c_str()));
  int frames = 0, coarse = 0;
  {
    After frame(scene.Steering, vtkEntireSteering::FrameEvent, [&] { ++frames; });
    After start(scene.Mapper, vtkCommand::VolumeMapperRenderStartEvent,
      [&] { coarse += Read(scene.Mapper).Distance > 1.01f ? 1 : 0; });
    vtkNew<vtkHardwareSelector> selector;
    selector->SetRenderer(scene.Renderer);
    selector->SetArea(0, 0, 159, 119);
    selector->SetFieldAssociation(vtkDataObject::FIELD_ASSOCIATION_CELLS);
    vtkSmartPointer<vtkSelection>::Take(selector->Select());
  }
  CHECK(frames == 0 && coarse == 0);
  CHECK(scene.Steering->GetNumberOfSteeredFrames() == steered);
  CHECK(scene.Steering->SaveState(after.c_str()));
  CHECK(!Bytes(before).empty() && Bytes(before) == Bytes(after));
  // A frame changes the learned state.
  scene.Draw();
  CHECK(scene.Steering->GetNumberOfSteeredFrames() == steered + 1);
  CHECK(scene.Steering->SaveState(later.c_str()));
  CHECK(Bytes(later) != Bytes(before));
}

// Steering does not change a mapper's MTime, since the GPU mapper would then compose its shader again.
void LeavesModifiedTimesAlone(Kind kind)
{
  Work scene(kind);
  int told = 0;
  After modified(scene.Mapper, vtkCommand::ModifiedEvent, [&] { ++told; });
  const vtkMTimeType before = scene.Mapper->GetMTime();
  for (const double coarsest : { 3.0, 2.0, 5.0 })
  {
    scene.Steering->SetCoarsestSampleDistance(coarsest);
    scene.Draw();
    CHECK(scene.Steering->GetSampleDistance() > 1.5);
  }
  CHECK(scene.Mapper->GetMTime() == before && told == 0);
}

// A window that counts the waits for its device.
class CountingWindow : public vtkXOpenGLRenderWindow
{
public:
  static CountingWindow* New();
  vtkTypeMacro(CountingWindow, vtkXOpenGLRenderWindow);
  void WaitForCompletion() override
  {
    ++this->Waits;
    this->Superclass::WaitForCompletion();
  }
  int Waits = 0;
};
vtkStandardNewMacro(CountingWindow);

// A GPU mapper's time begins when the device has finished earlier work; a mapper on the CPU does not wait.
void WaitsForTheDevice(Kind kind)
{
  Scene scene(kind);
  vtkNew<CountingWindow> window;
  window->SetOffScreenRendering(1);
  window->SetSize(160, 120);
  scene.Window->RemoveRenderer(scene.Renderer);
  window->AddRenderer(scene.Renderer);
  window->SetDesiredUpdateRate(15);
  vtkNew<vtkEntireSteering> steering;
  steering->SetTargetFrameTime(1000);
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  window->Render();
  int atStart = 0;
  const int before = window->Waits;
  {
    After start(
      scene.Mapper, vtkCommand::VolumeMapperRenderStartEvent, [&] { atStart = window->Waits - before; });
    window->Render();
  }
  CHECK(steering->GetNumberOfSteeredFrames() > 0);
  CHECK(atStart == (kind == GPU ? 1 : 0) && window->Waits - before == (kind == GPU ? 2 : 0));
  window->RemoveRenderer(scene.Renderer);
  scene.Window->AddRenderer(scene.Renderer);
}

// A volume in an assembly is planned where the assembly's matrix places it, like a volume with this matrix of its own.
void FollowsAssemblies(Kind kind)
{
  const char* const model = std::getenv("ENTIRE_TEST_MODEL");
  CHECK(model);
  const auto predicted = [&](bool assembled, double scale) {
    Scene scene(kind);
    vtkNew<vtkAssembly> assembly;
    vtkProp3D* moved = scene.Volume;
    if (assembled)
    {
      scene.Renderer->RemoveVolume(scene.Volume);
      assembly->AddPart(scene.Volume);
      scene.Renderer->AddViewProp(assembly);
      moved = assembly;
    }
    moved->SetScale(scale);
    moved->SetPosition(3, 2, 1);
    scene.Renderer->ResetCameraClippingRange();
    vtkNew<vtkEntireSteering> steering;
    steering->SetTargetFrameTime(1e-6);
    steering->SetModelFileName(model);
    CHECK(steering->Attach(scene.Renderer, scene.Volume));
    scene.Interactive();
    for (int i = 0; i < 3 && steering->GetNumberOfSteeredFrames() == 0; ++i)
    {
      scene.Draw();
    }
    CHECK(steering->GetNumberOfSteeredFrames() == 1 && Empty(steering->GetStatus()));
    return steering->GetPredictedTime();
  };
  const double small = predicted(true, 0.5);
  CHECK(small > 0 && small == predicted(false, 0.5) && small != predicted(false, 1.0));
}

// An assembly that counts how often its paths are built again while it draws volumes. It keeps the paths that it
// iterates over alive, even if they are built again meanwhile.
class CountedAssembly : public vtkAssembly
{
public:
  static CountedAssembly* New();
  vtkTypeMacro(CountedAssembly, vtkAssembly);
  int RenderVolumetricGeometry(vtkViewport* viewport) override
  {
    this->UpdatePaths();
    const vtkSmartPointer<vtkAssemblyPaths> drawn(this->Paths);
    const int rendered = this->Superclass::RenderVolumetricGeometry(viewport);
    ++this->Drawn;
    this->Rebuilt += this->Paths != drawn.GetPointer();
    return rendered;
  }
  int Drawn = 0;
  int Rebuilt = 0;
};
vtkStandardNewMacro(CountedAssembly);

// An assembly of several parts keeps its paths while it draws.
void LeavesPathsAlone(Kind kind)
{
  Scene scene(kind);
  vtkNew<CountedAssembly> assembly;
  vtkNew<vtkActor> other;
  scene.Renderer->RemoveVolume(scene.Volume);
  assembly->AddPart(scene.Volume);
  assembly->AddPart(other);
  scene.Renderer->AddViewProp(assembly);
  vtkNew<vtkEntireSteering> steering;
  steering->SetTargetFrameTime(1e-6);
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  scene.Interactive();
  scene.Draw(4);
  CHECK(steering->GetNumberOfSteeredFrames() > 1 && Empty(steering->GetStatus()));
  CHECK(assembly->Drawn >= 4 && assembly->Rebuilt == 0);
}

// The library gets the quality law that was set for the class of the drawing mapper, and checks it. A law for another
// class has no effect.
void KnowsItsPictures(Kind kind)
{
  Work scene(kind);
  const bool fixed = kind == FIXED || kind == SMART_FIXED;
  const auto set = [&](bool own, double weight) {
    if (own == fixed)
    {
      scene.Steering->SetFixedPointQuality(weight, 1, 1, 0);
    }
    else
    {
      scene.Steering->SetGPUQuality(weight, 1, 1, 0);
    }
    scene.Draw();
  };
  set(false, -1);
  CHECK(Empty(scene.Steering->GetStatus()));
  set(true, -1);
  CHECK(Is(scene.Steering->GetReason(), "fallback") && Says(scene.Steering->GetStatus(), "image weight of the picture quality law is -1"));
  for (const double weight : { 0.0, 3.0 })
  {
    set(true, weight);
    CHECK(Empty(scene.Steering->GetStatus()) && scene.Steering->GetImageSampleDistance() > 2);
  }
}

// Scalars that count the queries of their memory layout. Each reading of the voxels makes such queries.
class CountedScalars : public vtkDoubleArray
{
public:
  static CountedScalars* New();
  vtkTypeMacro(CountedScalars, vtkDoubleArray);
  bool HasStandardMemoryLayout() const override
  {
    ++this->Asked;
    return this->Superclass::HasStandardMemoryLayout();
  }
  mutable int Asked = 0;
};
vtkStandardNewMacro(CountedScalars);

// Gives scalars a value that is infinite in single precision.
void MakeInfinite(vtkDoubleArray* scalars)
{
  scalars->SetValue(0, 1e39);
}

// Attaches a steering to the scene's volume, with a target that no frame meets. Returns the observer of its warnings,
// which keeps them from being printed.
vtkSmartPointer<vtkTest::ErrorObserver> AttachedTo(Scene& scene, vtkEntireSteering* steering)
{
  auto warnings = vtkSmartPointer<vtkTest::ErrorObserver>::New();
  steering->AddObserver(vtkCommand::WarningEvent, warnings);
  steering->SetTargetFrameTime(1e-6);
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  scene.Interactive();
  return warnings;
}

// Voxels that cannot be used are read once, until they change.
void ReadsRefusedVoxelsOnce(Kind kind)
{
  Scene scene(kind);
  vtkDataArray* const usual = scene.Data->GetPointData()->GetScalars();
  vtkNew<CountedScalars> large;
  large->DeepCopy(usual);
  MakeInfinite(large);
  scene.Data->GetPointData()->SetScalars(large);
  vtkNew<vtkEntireSteering> steering;
  const auto warnings = AttachedTo(scene, steering);
  scene.Draw(4);
  CHECK(Is(steering->GetReason(), "fallback") && Says(steering->GetStatus(), "must be finite"));
  const auto asked = [&] {
    const int before = large->Asked;
    scene.Draw(2);
    return large->Asked - before;
  };
  const int steered = asked();
  CHECK(Is(steering->GetReason(), "fallback"));
  steering->Detach();
  scene.Draw();
  // VTK itself may ask in every frame.
  CHECK(steered == asked());
}

// Each drawing of a mapper that cannot be steered counts, also if other mappers of the frame are steered after it.
void CountsEachMapper(Kind kind)
{
  Scene scene(kind);
  const auto refused = Image(8);
  vtkNew<vtkDoubleArray> large;
  large->DeepCopy(refused->GetPointData()->GetScalars());
  MakeInfinite(large);
  refused->GetPointData()->SetScalars(large);
  vtkNew<vtkMultiBlockDataSet> blocks;
  blocks->SetBlock(0, refused);
  blocks->SetBlock(1, scene.Data);
  auto* const mapper = vtkMultiBlockVolumeMapper::SafeDownCast(scene.Mapper);
  CHECK(mapper);
  mapper->SetInputDataObject(blocks);
  mapper->SetRequestedRenderMode(vtkSmartVolumeMapper::RayCastRenderMode);
  vtkNew<vtkEntireSteering> steering;
  const auto warnings = AttachedTo(scene, steering);
  scene.Draw(2);
  for (const double azimuth : { 30.0, 210.0 })
  {
    // The mapper draws its blocks from back to front.
    scene.Pose(azimuth);
    const vtkIdType steered = steering->GetNumberOfSteeredFrames(), other = steering->GetNumberOfFallbackFrames();
    scene.Draw(2);
    CHECK(steering->GetNumberOfSteeredFrames() == steered + 2);
    CHECK(steering->GetNumberOfFallbackFrames() == other + 2);
  }
}

// A file that is not a model is read once, until Reset() or a change of its name.
void ReadsRefusedModelsOnce(Kind kind)
{
  Scene scene(kind);
  const std::string file = std::string(std::getenv("ENTIRE_TEST_FILE")) + ".safetensors";
  const char* const model = std::getenv("ENTIRE_TEST_MODEL");
  CHECK(model);
  vtkNew<vtkEntireSteering> steering;
  vtkNew<vtkTest::ErrorObserver> warnings;
  steering->AddObserver(vtkCommand::WarningEvent, warnings);
  steering->SetTargetFrameTime(1e-6);
  const auto refused = [&] {
    scene.Draw(3);
    return Is(steering->GetReason(), "fallback") && Says(steering->GetStatus(), file.c_str());
  };
  // A missing file is opened as soon as it exists.
  std::remove(file.c_str());
  steering->SetModelFileName(file.c_str());
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  scene.Interactive();
  CHECK(refused());
  std::ofstream(file) << "no model";
  CHECK(refused());
  std::ofstream(file, std::ios::binary) << Bytes(model);
  CHECK(refused());
  steering->Reset();
  CHECK(!refused() && Empty(steering->GetStatus()));
  std::remove(file.c_str());
}

// If the model's clock differs from the clock that times the frames, a warning is raised: once, and again after a
// change of the model or the clock.
void SaysItsClocks(Kind kind)
{
  Scene scene(kind);
  vtkNew<vtkEntireSteering> steering;
  vtkNew<vtkTest::ErrorObserver> warnings;
  steering->AddObserver(vtkCommand::WarningEvent, warnings);
  steering->SetTargetFrameTime(1e-6);
  // A model of the clock "cpu".
  const char* const model = std::getenv("ENTIRE_TEST_MODEL");
  CHECK(model);
  steering->SetModelFileName(model);
  CHECK(!steering->GetModelClock());
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  CHECK(Says(steering->GetStatus(), "timed by the wall clock"));
  scene.Interactive();
  const auto said = [&] {
    warnings->Clear();
    scene.Draw(3);
    CHECK(Empty(steering->GetStatus()) && steering->GetNumberOfFallbackFrames() == 0);
    return warnings->GetWarningMessage();
  };
  const std::string first = said();
  for (const char* words : { "predicts seconds of the cpu clock", "timed by the wall clock",
         "learned from the first frames", "entire calibrate --data TABLE --clock wall" })
  {
    CHECK(Says(first.c_str(), words) && first.find(words) == first.rfind(words));
  }
  CHECK(Is(steering->GetModelClock(), "cpu") && said().empty());
  std::ostringstream text;
  steering->Print(text);
  CHECK(Says(text.str().c_str(), "Clock: wall") && Says(text.str().c_str(), "ModelClock: cpu"));
  // Reset() does not repeat the warning; a change of clock or model, and a new attachment, do.
  steering->Reset();
  CHECK(said().empty());
  steering->SetClockToProcessCPU();
  CHECK(said().empty());
  steering->SetClockToWall();
  CHECK(Says(said().c_str(), "cpu clock"));
  steering->SetModelFileName(nullptr);
  CHECK(said().empty() && !steering->GetModelClock());
  steering->SetModelFileName(model);
  CHECK(Says(said().c_str(), "cpu clock"));
  CHECK(steering->Attach(scene.Renderer, scene.Volume));
  CHECK(Says(said().c_str(), "cpu clock"));
  steering->Detach();
  CHECK(!steering->GetModelClock());
}

// A still frame that AutoAdjustSampleDistances may have coarsened is not learned as a frame of full quality.
void LeavesCoarsenedFramesAlone(Kind kind)
{
  Work scene(kind);
  const std::string base = std::getenv("ENTIRE_TEST_FILE");
  const auto state = [&] {
    CHECK(scene.Steering->SaveState(base.c_str()));
    return Bytes(base);
  };
  const std::string before = state();
  const auto predicted = [&](double rate) {
    scene.Window->SetDesiredUpdateRate(rate);
    scene.Draw();
    CHECK(Is(scene.Steering->GetReason(), "still"));
    return !std::isnan(scene.Steering->GetPredictedTime());
  };
  AsItsClass(scene.Mapper, [](auto* mapper) { mapper->AutoAdjustSampleDistancesOn(); });
  CHECK(!before.empty() && !predicted(0.5) && state() == before);
  CHECK(predicted(0.0001));
  AsItsClass(scene.Mapper, [](auto* mapper) { mapper->AutoAdjustSampleDistancesOff(); });
  CHECK(predicted(0.5));
}

// A clock that is set during a frame times the next frame: no time is a difference of two clocks.
void KeepsTheClockOfAFrame(Kind kind)
{
  Work scene(kind);
  // A mapper that contains others does not forward their events.
  const bool inside = kind == FIXED || kind == GPU;
  vtkObject* const subject = inside ? static_cast<vtkObject*>(scene.Mapper) : scene.Renderer;
  const auto event = inside ? vtkCommand::VolumeMapperRenderStartEvent : vtkCommand::StartEvent;
  const auto timed = [&] {
    const double mapper = scene.Steering->GetMeasuredTime(), frame = scene.Steering->GetFrameTime();
    return mapper >= 0 && frame >= mapper && frame < 300;
  };
  for (const int clock : { vtkEntireSteering::PROCESS_CPU, vtkEntireSteering::WALL })
  {
    {
      const After start(subject, event, [&] { scene.Steering->SetClock(clock); });
      scene.Draw();
    }
    CHECK(scene.Steering->GetClock() == clock && timed());
    const vtkIdType steered = scene.Steering->GetNumberOfSteeredFrames();
    scene.Draw();
    CHECK(scene.Steering->GetNumberOfSteeredFrames() == steered + 1 && timed());
  }
}

const std::map<std::string, std::function<void(Kind)>> TESTS = {
  { "NoticesChangedVoxels", NoticesChangedVoxels },
  { "NoticesNewFunctionsOnly", NoticesNewFunctionsOnly },
  { "LeavesPickingAlone", LeavesPickingAlone },
  { "LeavesModifiedTimesAlone", LeavesModifiedTimesAlone },
  { "WaitsForTheDevice", WaitsForTheDevice },
  { "FollowsAssemblies", FollowsAssemblies },
  { "LeavesPathsAlone", LeavesPathsAlone },
  { "KnowsItsPictures", KnowsItsPictures },
  { "ReadsRefusedVoxelsOnce", ReadsRefusedVoxelsOnce },
  { "CountsEachMapper", CountsEachMapper },
  { "ReadsRefusedModelsOnce", ReadsRefusedModelsOnce },
  { "SaysItsClocks", SaysItsClocks },
  { "LeavesCoarsenedFramesAlone", LeavesCoarsenedFramesAlone },
  { "KeepsTheClockOfAFrame", KeepsTheClockOfAFrame },
};
}

int main(int argc, char* argv[])
{
  return Main(argc, argv, TESTS);
}
