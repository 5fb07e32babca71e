// SPDX-License-Identifier: MIT OR Apache-2.0
// Access to volume mappers: the mappers that draw, their settings, and the steering that owns each mapper for a frame.
#ifndef vtkEntireMapperAccess_h
#define vtkEntireMapperAccess_h

#include "vtkType.h"

#include <string>
#include <vector>

class vtkAbstractVolumeMapper;
class vtkImageData;
class vtkSmartVolumeMapper;
class vtkVolumeMapper;

namespace vtkEntire
{
// A mapper that draws.
struct LeafMapper
{
  vtkVolumeMapper* Mapper;
  // The smart mapper around it; null if there is none.
  vtkSmartVolumeMapper* Outer;
  // True for a vtkGPUVolumeRayCastMapper, false for a vtkFixedPointVolumeRayCastMapper.
  bool Gpu;
};

// Adds the mappers that draw: the given one, or those inside it. Adds none for a mapper of another class.
void FindLeafMappers(vtkAbstractVolumeMapper* mapper, std::vector<LeafMapper>& found);

// The reason why a mapper cannot be steered with its current settings; empty if it can.
std::string Refusal(vtkAbstractVolumeMapper* mapper);

// True if a GPU mapper jitters ray starts, or lights samples by scattering: both change the time of the same rays.
// `gpu` is LeafMapper::Gpu.
bool Jitters(vtkVolumeMapper* mapper, bool gpu);
bool Scatters(vtkVolumeMapper* mapper, bool gpu);

// The sample distance of a mapper that is locked to the spacing of its input.
double SpacingAdjustedSampleDistance(vtkVolumeMapper* mapper, vtkImageData* image);

// The settings of a mapper that steering changes for one frame. `gpu` is LeafMapper::Gpu.
//
// They are written to the members directly, without an event and without a change of the mapper's MTime: the GPU mapper
// would compose its shader again if its MTime changed, and reads its distances in every frame anyway.
struct MapperSettings
{
  float SampleDistance = 1.0f;
  float ImageSampleDistance = 1.0f;
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool Lock = 0;

  static MapperSettings Read(vtkVolumeMapper* mapper, bool gpu);
  void Write(vtkVolumeMapper* mapper, bool gpu) const;
  // These settings, but with the values of `now` that differ from `written`: the application changed them meanwhile.
  MapperSettings Keeping(const MapperSettings& now, const MapperSettings& written) const;
};

// The settings of a smart mapper that would override those of the fixed-point mapper inside it. They are written like
// MapperSettings.
struct SmartSettings
{
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool InteractiveAdjust = 0;
  float SampleDistance = -1.0f;

  static SmartSettings Read(vtkSmartVolumeMapper* mapper);
  void Write(vtkSmartVolumeMapper* mapper) const;
  SmartSettings Keeping(const SmartSettings& now, const SmartSettings& written) const;
};

// Claims a mapper for the steering `who`; returns false if another steering has claimed it. ReleaseClaim() releases all
// claims of `who`.
bool ClaimMapper(const vtkVolumeMapper* mapper, const void* who);
void ReleaseClaim(const void* who);
}

#endif
