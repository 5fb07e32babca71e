// SPDX-License-Identifier: MIT OR Apache-2.0
// Shared parts of the tests: a scene with one volume, and the settings of its mapper.
#ifndef EntireTestScene_h
#define EntireTestScene_h

#include "vtkCallbackCommand.h"
#include "vtkCamera.h"
#include "vtkColorTransferFunction.h"
#include "vtkFixedPointVolumeRayCastMapper.h"
#include "vtkImageData.h"
#include "vtkMultiBlockDataSet.h"
#include "vtkMultiBlockVolumeMapper.h"
#include "vtkNew.h"
#include "vtkOpenGLGPUVolumeRayCastMapper.h"
#include "vtkPiecewiseFunction.h"
#include "vtkRenderWindow.h"
#include "vtkRenderer.h"
#include "vtkSmartPointer.h"
#include "vtkSmartVolumeMapper.h"
#include "vtkVolume.h"
#include "vtkVolumeProperty.h"
#include "vtkWindowToImageFilter.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <iostream>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace EntireTest
{
#define CHECK(condition) \
  do \
  { \
    if (!(condition)) \
    { \
      std::cerr << __FILE__ << ":" << __LINE__ << ": " << #condition << "\n"; \
      std::exit(EXIT_FAILURE); \
    } \
  } while (false)

constexpr int EDGE = 48;

inline vtkSmartPointer<vtkImageData> Image(int edge = EDGE)
{
  auto image = vtkSmartPointer<vtkImageData>::New();
  image->SetDimensions(edge, edge, edge);
  image->SetOrigin(-0.5 * edge, -0.5 * edge, -0.5 * edge);
  image->AllocateScalars(VTK_UNSIGNED_CHAR, 1);
  auto* voxels = static_cast<unsigned char*>(image->GetScalarPointer());
  for (int z = 0; z < edge; ++z)
  {
    for (int y = 0; y < edge; ++y)
    {
      for (int x = 0; x < edge; ++x)
      {
        const double r = std::hypot(x - 0.5 * edge, y - 0.5 * edge, z - 0.5 * edge) / (0.5 * edge);
        const double wave = std::sin(0.9 * x) * std::sin(0.7 * y) * std::sin(0.8 * z);
        *voxels++ = static_cast<unsigned char>(255 * std::max(0.0, std::min(1.0, 1.1 - r + 0.3 * wave)));
      }
    }
  }
  return image;
}

enum Kind
{
  FIXED,
  GPU,
  SMART,
  SMART_FIXED,
  BLOCKS
};
inline const std::map<std::string, Kind> KINDS = { { "fixed", FIXED }, { "gpu", GPU }, { "smart", SMART },
  { "smart-fixed", SMART_FIXED }, { "blocks", BLOCKS } };

struct Scene
{
  vtkSmartPointer<vtkVolumeMapper> Mapper;
  vtkSmartPointer<vtkImageData> Data = Image();
  vtkNew<vtkVolume> Volume;
  vtkNew<vtkVolumeProperty> Property;
  vtkNew<vtkPiecewiseFunction> Opacity;
  vtkNew<vtkColorTransferFunction> Color;
  vtkNew<vtkRenderer> Renderer;
  vtkNew<vtkRenderWindow> Window;

  explicit Scene(Kind kind)
  {
    if (kind == FIXED)
    {
      this->Mapper = vtkSmartPointer<vtkFixedPointVolumeRayCastMapper>::New();
    }
    else if (kind == GPU)
    {
      this->Mapper = vtkSmartPointer<vtkOpenGLGPUVolumeRayCastMapper>::New();
    }
    else if (kind == BLOCKS)
    {
      this->Mapper = vtkSmartPointer<vtkMultiBlockVolumeMapper>::New();
    }
    else
    {
      auto smart = vtkSmartPointer<vtkSmartVolumeMapper>::New();
      if (kind == SMART_FIXED)
      {
        smart->SetRequestedRenderModeToRayCast();
      }
      else
      {
        smart->SetRequestedRenderModeToGPU();
      }
      this->Mapper = smart;
    }
    if (kind == BLOCKS)
    {
      vtkNew<vtkMultiBlockDataSet> blocks;
      blocks->SetBlock(0, this->Data);
      this->Mapper->SetInputDataObject(blocks);
    }
    else
    {
      this->Mapper->SetInputDataObject(this->Data);
    }
    this->Opacity->AddPoint(0, 0.0);
    this->Opacity->AddPoint(60, 0.0);
    this->Opacity->AddPoint(255, 0.2, 0.4, 0.2);
    this->Color->AddRGBPoint(0, 0.1, 0.2, 0.6);
    this->Color->AddRGBPoint(255, 1.0, 0.9, 0.3);
    this->Property->SetInterpolationTypeToLinear();
    this->Property->SetScalarOpacity(this->Opacity);
    this->Property->SetColor(this->Color);
    this->Volume->SetMapper(this->Mapper);
    this->Volume->SetProperty(this->Property);
    this->Renderer->AddVolume(this->Volume);
    this->Window->SetOffScreenRendering(1);
    this->Window->SetMultiSamples(0);
    this->Window->SetSize(160, 120);
    this->Window->AddRenderer(this->Renderer);
    this->Pose(30);
  }

  void Pose(double azimuth)
  {
    const double a = azimuth * 3.14159265358979 / 180;
    vtkCamera* camera = this->Renderer->GetActiveCamera();
    camera->SetFocalPoint(0, 0, 0);
    camera->SetPosition(2.2 * EDGE * std::sin(a), 20, 2.2 * EDGE * std::cos(a));
    this->Renderer->ResetCameraClippingRange();
  }

  // Sets the update rate that an interactor sets while a mouse button is down.
  void Interactive() { this->Window->SetDesiredUpdateRate(15); }

  // Replaces the mapper by a new one of the same class.
  void ReplaceMapper()
  {
    vtkVolumeMapper* const before = vtkVolumeMapper::SafeDownCast(this->Volume->GetMapper());
    const auto next = vtkSmartPointer<vtkVolumeMapper>::Take(before->NewInstance());
    next->SetInputConnection(before->GetInputConnection(0, 0));
    this->Volume->SetMapper(next);
  }

  // Draws frames; returns the pixels of the last one.
  std::vector<unsigned char> Draw(int frames = 1)
  {
    for (int i = 0; i < frames; ++i)
    {
      this->Window->Render();
    }
    vtkNew<vtkWindowToImageFilter> grab;
    grab->SetInput(this->Window);
    grab->ShouldRerenderOff();
    grab->ReadFrontBufferOff();
    grab->Update();
    vtkImageData* out = grab->GetOutput();
    const auto* bytes = static_cast<unsigned char*>(out->GetScalarPointer());
    return { bytes, bytes + out->GetNumberOfPoints() * out->GetNumberOfScalarComponents() };
  }
};

struct Settings
{
  float Distance, ImageDistance;
  int Auto, Lock;
  bool operator==(const Settings& o) const
  {
    return this->Distance == o.Distance && this->ImageDistance == o.ImageDistance && this->Auto == o.Auto &&
      this->Lock == o.Lock;
  }
};

template <class Mapper>
Settings Of(Mapper* mapper)
{
  return { mapper->GetSampleDistance(), mapper->GetImageSampleDistance(),
    mapper->GetAutoAdjustSampleDistances(), mapper->GetLockSampleDistanceToInputSpacing() };
}
inline Settings Of(vtkSmartVolumeMapper* mapper)
{
  return { mapper->GetSampleDistance(), 1, mapper->GetAutoAdjustSampleDistances(),
    mapper->GetInteractiveAdjustSampleDistances() };
}

// Calls a function with a GPU, fixed-point or smart mapper as an object of its class; does nothing with other mappers.
template <class Function>
void AsItsClass(vtkVolumeMapper* mapper, Function what)
{
  if (auto* gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
  {
    what(gpu);
  }
  else if (auto* cpu = vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper))
  {
    what(cpu);
  }
  else if (auto* smart = vtkSmartVolumeMapper::SafeDownCast(mapper))
  {
    what(smart);
  }
}

inline Settings Read(vtkVolumeMapper* mapper)
{
  Settings settings = { 0, 0, 0, 0 };
  AsItsClass(mapper, [&](auto* each) { settings = Of(each); });
  return settings;
}

// Calls a function at every event of an object, after the steering's observer.
class After
{
public:
  After(vtkObject* subject, unsigned long event, std::function<void()> what)
    : Subject(subject)
    , What(std::move(what))
  {
    this->Command->SetClientData(this);
    this->Command->SetCallback(
      [](vtkObject*, unsigned long, void* data, void*) { static_cast<After*>(data)->What(); });
    this->Tag = subject->AddObserver(event, this->Command, -1.0f);
  }
  ~After() { this->Subject->RemoveObserver(this->Tag); }
  After(const After&) = delete;
  void operator=(const After&) = delete;

private:
  vtkObject* Subject;
  std::function<void()> What;
  vtkNew<vtkCallbackCommand> Command;
  unsigned long Tag;
};

// Runs the test that the program's arguments name, with the mapper that they name.
inline int Main(int argc, char* argv[], const std::map<std::string, std::function<void(Kind)>>& tests)
{
  const auto test = argc == 3 ? tests.find(argv[1]) : tests.end();
  const auto kind = argc == 3 ? KINDS.find(argv[2]) : KINDS.end();
  if (test == tests.end() || kind == KINDS.end())
  {
    std::cerr << "usage: " << argv[0] << " NAME MAPPER, with NAME one of";
    for (const auto& each : tests)
    {
      std::cerr << " " << each.first;
    }
    std::cerr << " and MAPPER one of";
    for (const auto& each : KINDS)
    {
      std::cerr << " " << each.first;
    }
    std::cerr << "\n";
    return 2;
  }
  test->second(kind->second);
  return EXIT_SUCCESS;
}

inline bool Empty(const char* text)
{
  return !text || !*text;
}

inline bool Is(const char* text, const char* what)
{
  return text && !std::strcmp(text, what);
}

inline bool Says(const char* text, const char* what)
{
  return text && std::strstr(text, what);
}
}

#endif
