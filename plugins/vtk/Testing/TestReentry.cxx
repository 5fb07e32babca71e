// SPDX-License-Identifier: MIT OR Apache-2.0
// Tests of observers that call vtkEntireSteering, or remove objects to which it is attached: TestReentry EVENT MAPPER.
// Every action is tried in the event, by an observer that is called before the steering's own and by one that
// is called after it. Built with AddressSanitizer, the test shows that no object is used after it was deleted.
#include "Scene.h"

#include "vtkCallbackCommand.h"
#include "vtkEntireMapperAccess.h"
#include "vtkEntireSteering.h"
#include "vtkImageShiftScale.h"
#include "vtkMultiBlockDataGroupFilter.h"
#include "vtkWeakPointer.h"

#include <functional>

using namespace EntireTest;

namespace
{
// A scene whose mapper gets its input from a pipeline, with a steering.
struct Stage : Scene
{
  Kind MapperKind;
  vtkNew<vtkImageShiftScale> Filter;
  vtkNew<vtkMultiBlockDataGroupFilter> Group;
  vtkSmartPointer<vtkEntireSteering> Steering;
  bool Deleted = false;

  explicit Stage(Kind kind)
    : Scene(kind)
    , MapperKind(kind)
  {
    this->Filter->SetInputData(this->Data);
    this->Filter->SetOutputScalarTypeToUnsignedChar();
    this->Filter->ClampOverflowOn();
    if (kind == BLOCKS)
    {
      this->Group->AddInputConnection(this->Filter->GetOutputPort());
      this->Mapper->SetInputConnection(this->Group->GetOutputPort());
    }
    else
    {
      this->Mapper->SetInputConnection(this->Filter->GetOutputPort());
    }
    this->StopAdjusting();
    this->Interactive();
    // Inner mappers are made and connected in the first frames.
    this->Draw(2);
  }

  // Turns automatic adjustment off, so that only the application and the steering set image sample distances.
  void StopAdjusting()
  {
    AsItsClass(this->Mapper, [](auto* mapper) { mapper->AutoAdjustSampleDistancesOff(); });
    if (auto* smart = vtkSmartVolumeMapper::SafeDownCast(this->Mapper))
    {
      smart->InteractiveAdjustSampleDistancesOff();
    }
  }

  std::vector<vtkEntire::LeafMapper> Leaves()
  {
    std::vector<vtkEntire::LeafMapper> found;
    vtkEntire::FindLeafMappers(this->Mapper, found);
    return found;
  }

  // The settings of every mapper that draws or contains one that does.
  std::vector<Settings> AllSettings()
  {
    std::vector<Settings> all = { Read(this->Mapper) };
    for (const auto& leaf : this->Leaves())
    {
      const auto settings = vtkEntire::MapperSettings::Read(leaf.Mapper, leaf.Gpu);
      all.push_back({ settings.SampleDistance, settings.AutoAdjust ? 0 : settings.ImageSampleDistance,
        settings.AutoAdjust, settings.Lock });
      if (leaf.Outer)
      {
        all.push_back(Read(leaf.Outer));
      }
    }
    return all;
  }

  // A new steering, attached to this scene.
  void Begin()
  {
    this->Steering = vtkSmartPointer<vtkEntireSteering>::New();
    this->Steering->SetTargetFrameTime(1e-6);
    this->Deleted = false;
    vtkNew<vtkCallbackCommand> gone;
    gone->SetClientData(&this->Deleted);
    gone->SetCallback([](vtkObject*, unsigned long, void* data, void*) { *static_cast<bool*>(data) = true; });
    this->Steering->AddObserver(vtkCommand::DeleteEvent, gone);
    CHECK(this->Steering->Attach(this->Renderer, this->Volume));
    this->Window->Render();
    this->Window->Render();
    CHECK(this->Steering->GetNumberOfSteeredFrames() > 0);
  }

  // Makes the pipeline execute again.
  void Touch() { this->Filter->SetShift(this->Filter->GetShift() > 0 ? 0 : 1); }
};

// Calls a function once: at the first event of any of the given objects.
class Once
{
public:
  Once(const std::vector<vtkObject*>& subjects, unsigned long event, float priority,
    std::function<void()> what)
    : What(std::move(what))
  {
    this->Command->SetClientData(this);
    this->Command->SetCallback([](vtkObject*, unsigned long, void* data, void*) {
      auto* self = static_cast<Once*>(data);
      if (self->Count++ == 0)
      {
        self->What();
      }
    });
    for (vtkObject* subject : subjects)
    {
      this->Subjects.emplace_back(subject, subject->AddObserver(event, this->Command, priority));
    }
  }
  ~Once()
  {
    // Removes the observers of objects that still exist.
    for (const auto& each : this->Subjects)
    {
      if (each.first)
      {
        each.first->RemoveObserver(each.second);
      }
    }
  }
  Once(const Once&) = delete;
  void operator=(const Once&) = delete;

  int Count = 0;

private:
  std::function<void()> What;
  vtkNew<vtkCallbackCommand> Command;
  std::vector<std::pair<vtkWeakPointer<vtkObject>, unsigned long>> Subjects;
};

struct Event
{
  // Objects that invoke the event.
  std::function<std::vector<vtkObject*>(Stage&)> Subjects;
  unsigned long Id;
  // Makes the event happen in the next frame; nullptr if it happens in every frame.
  std::function<void(Stage&)> Provoke;
  // True if the event comes between a mapper's start and end, or while VTK updates the mapper's input: VTK itself
  // cannot handle an exchange of the mapper or of the OpenGL context at that time.
  std::function<bool(Kind)> InsideMapper;
};

bool Never(Kind)
{
  return false;
}
bool Always(Kind)
{
  return true;
}
// A fixed-point mapper's pipeline is updated before the mapper draws.
bool UnlessFixed(Kind kind)
{
  return kind != FIXED;
}

std::vector<vtkObject*> WindowOf(Stage& stage)
{
  return { stage.Window };
}
std::vector<vtkObject*> RendererOf(Stage& stage)
{
  return { stage.Renderer };
}
std::vector<vtkObject*> SteeringOf(Stage& stage)
{
  return { stage.Steering };
}
std::vector<vtkObject*> FilterOf(Stage& stage)
{
  return { stage.Filter };
}
std::vector<vtkObject*> MappersOf(Stage& stage)
{
  std::vector<vtkObject*> mappers;
  for (const auto& leaf : stage.Leaves())
  {
    mappers.push_back(leaf.Mapper);
  }
  return mappers;
}

void MissingModel(Stage& stage)
{
  stage.Steering->SetModelFileName("/nowhere/model.safetensors");
}
void BadState(Stage& stage)
{
  stage.Steering->LoadState("/");
}

const std::map<std::string, Event> EVENTS = {
  { "WindowStart", { WindowOf, vtkCommand::StartEvent, nullptr, Never } },
  { "WindowEnd", { WindowOf, vtkCommand::EndEvent, nullptr, Never } },
  { "RendererStart", { RendererOf, vtkCommand::StartEvent, nullptr, Never } },
  { "RendererEnd", { RendererOf, vtkCommand::EndEvent, nullptr, Never } },
  { "MapperStart", { MappersOf, vtkCommand::VolumeMapperRenderStartEvent, nullptr, Always } },
  { "MapperEnd", { MappersOf, vtkCommand::VolumeMapperRenderEndEvent, nullptr, Always } },
  { "PipelineStart", { FilterOf, vtkCommand::StartEvent, &Stage::Touch, UnlessFixed } },
  { "PipelineProgress", { FilterOf, vtkCommand::ProgressEvent, &Stage::Touch, UnlessFixed } },
  { "PipelineEnd", { FilterOf, vtkCommand::EndEvent, &Stage::Touch, UnlessFixed } },
  { "Warning", { SteeringOf, vtkCommand::WarningEvent, MissingModel, Never } },
  { "Error", { SteeringOf, vtkCommand::ErrorEvent, BadState, Never } },
  { "Frame", { SteeringOf, vtkEntireSteering::FrameEvent, nullptr, Never } },
};

// Draws frames after the event and checks that steering has resumed.
void GoesOn(Stage& stage)
{
  stage.Steering->SetModelFileName(nullptr);
  const vtkIdType before = stage.Steering->GetNumberOfSteeredFrames();
  for (int i = 0; i < 3; ++i)
  {
    stage.Window->Render();
  }
  CHECK(stage.Steering->GetNumberOfSteeredFrames() > before);
  CHECK(Empty(stage.Steering->GetStatus()));
}

struct Action
{
  std::function<void(Stage&)> Do;
  // Called after the frame.
  std::function<void(Stage&)> Check;
  // False if the action cannot be done in an event with Event::InsideMapper.
  bool InsideMapper;
  // False if the action cannot be done in an event during the renderer's frame.
  bool InsideRenderer = true;
};

std::map<std::string, Action> Actions(const std::vector<Settings>& own)
{
  const auto released = [own](Stage& stage) {
    CHECK(stage.AllSettings() == own);
    stage.Window->Render();
  };
  return {
    { "Detach",
      { [](Stage& stage) { stage.Steering->Detach(); },
        [released](Stage& stage) {
          released(stage);
          CHECK(!stage.Steering->GetVolume() && stage.Steering->GetNumberOfSteeredFrames() == 0);
          CHECK(Is(stage.Steering->GetStatus(), "attached to nothing") && !stage.Steering->GetReason());
        },
        true } },
    { "Drop",
      { [](Stage& stage) { stage.Steering = nullptr; },
        [released](Stage& stage) {
          CHECK(stage.Deleted);
          released(stage);
        },
        true } },
    { "DetachAndDrop",
      { [](Stage& stage) {
         stage.Steering->Detach();
         stage.Steering = nullptr;
       },
        [released](Stage& stage) {
          CHECK(stage.Deleted);
          released(stage);
        },
        true } },
    { "AttachAgain",
      { [](Stage& stage) { CHECK(stage.Steering->Attach(stage.Renderer, stage.Volume)); }, GoesOn, true } },
    { "AttachToNothing",
      { [](Stage& stage) { CHECK(!stage.Steering->Attach(nullptr, nullptr)); }, released, true } },
    { "Reset", { [](Stage& stage) { stage.Steering->Reset(); }, GoesOn, true } },
    { "ExchangeModel",
      { [](Stage& stage) { stage.Steering->SetModelFileName("/nowhere/other"); }, GoesOn, true } },
    { "LoadNoState", { [](Stage& stage) { CHECK(!stage.Steering->LoadState("/")); }, GoesOn, true } },
    { "RemoveVolume",
      { [](Stage& stage) { stage.Renderer->RemoveVolume(stage.Volume); },
        [own](Stage& stage) {
          CHECK(stage.AllSettings() == own);
          const vtkIdType before = stage.Steering->GetNumberOfSteeredFrames();
          stage.Window->Render();
          CHECK(stage.Steering->GetNumberOfSteeredFrames() == before);
          stage.Renderer->AddVolume(stage.Volume);
          GoesOn(stage);
        },
        false } },
    { "ExchangeMapper",
      { [](Stage& stage) {
         auto other = vtkSmartPointer<vtkFixedPointVolumeRayCastMapper>::New();
         other->SetInputDataObject(stage.Data);
         stage.Volume->SetMapper(other);
       },
        [own](Stage& stage) {
          stage.Window->Render();
          CHECK(stage.AllSettings() == own);
          GoesOn(stage);
          stage.Volume->SetMapper(stage.Mapper);
          GoesOn(stage);
        },
        false } },
    { "DrawAnother",
      { [](Stage& stage) {
         Scene other(stage.MapperKind);
         vtkNew<vtkEntireSteering> steering;
         CHECK(steering->Attach(other.Renderer, other.Volume));
         other.Interactive();
         other.Window->Render();
       },
        GoesOn, false, false } },
  };
}

void Run(const std::string& name, const Event& event, Kind kind)
{
  Stage stage(kind);
  const std::vector<Settings> own = stage.AllSettings();
  const bool inside = event.InsideMapper(kind);
  const bool insideRenderer = inside || name == "RendererStart" || name == "RendererEnd" ||
    name.compare(0, 8, "Pipeline") == 0;
  int tried = 0;
  for (const auto& each : Actions(own))
  {
    const Action& action = each.second;
    if ((inside && !action.InsideMapper) || (insideRenderer && !action.InsideRenderer))
    {
      continue;
    }
    if (name == "Error" && (each.first == "LoadNoState" || each.first == "AttachToNothing"))
    {
      // Actions that report an error would invoke the event again, without end.
      continue;
    }
    for (const float priority : { 2.0f, -1.0f })
    {
      std::cerr << name << ": " << each.first << ", priority " << priority << "\n";
      stage.Begin();
      {
        Once once(event.Subjects(stage), event.Id, priority, [&] { action.Do(stage); });
        if (event.Provoke)
        {
          event.Provoke(stage);
        }
        stage.Window->Render();
        CHECK(once.Count > 0);
      }
      action.Check(stage);
      stage.Steering = nullptr;
      CHECK(stage.Deleted);
      CHECK(stage.AllSettings() == own);
      ++tried;
    }
  }
  CHECK(tried >= 12);
}
}

int main(int argc, char* argv[])
{
  std::map<std::string, std::function<void(Kind)>> tests;
  for (const auto& each : EVENTS)
  {
    tests[each.first] = [&each](Kind kind) { Run(each.first, each.second, kind); };
  }
  return Main(argc, argv, tests);
}
