// SPDX-License-Identifier: MIT OR Apache-2.0
// Access to volume mappers: the mappers that draw, their settings, and claims, so that only one object steers a mapper.
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
// A mapper that draws without other mappers inside it.
struct LeafMapper
{
  vtkVolumeMapper* Mapper;
  // The smart mapper around it; null if there is none.
  vtkSmartVolumeMapper* Outer;
  // True for a vtkGPUVolumeRayCastMapper, false for a vtkFixedPointVolumeRayCastMapper.
  bool Gpu;
};

// Adds to `found` the mappers that draw for `mapper`: `mapper` itself, or mappers inside it. Adds nothing if a mapper
// of this class cannot be steered.
void FindLeafMappers(vtkAbstractVolumeMapper* mapper, std::vector<LeafMapper>& found);

// The reason why a mapper cannot be steered with its current settings; empty if it can.
std::string Refusal(vtkAbstractVolumeMapper* mapper);

// Jitters() returns true if a GPU mapper jitters the starts of rays, Scatters() if it lights samples by scattering.
// Both change the time that a ray takes. `gpu` is LeafMapper::Gpu.
bool Jitters(vtkVolumeMapper* mapper, bool gpu);
bool Scatters(vtkVolumeMapper* mapper, bool gpu);

// Returns the sample distance of a mapper that is locked to the spacing of its input.
double SpacingAdjustedSampleDistance(vtkVolumeMapper* mapper, vtkImageData* image);

// The settings of a mapper that steering changes for one frame. `gpu` is LeafMapper::Gpu.
//
// They are written to the members directly, without an event and without a change of the mapper's MTime: the GPU mapper
// would compose its shader again if its MTime changed, and reads its sample distances in every frame anyway.
struct MapperSettings
{
  float SampleDistance = 1.0f;
  float ImageSampleDistance = 1.0f;
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool Lock = 0;

  static MapperSettings Read(vtkVolumeMapper* mapper, bool gpu);
  void Write(vtkVolumeMapper* mapper, bool gpu) const;
  // Returns these settings, except that values of `now` that differ from `written` replace them: the application has
  // changed these values since `written` was written.
  MapperSettings Keeping(const MapperSettings& now, const MapperSettings& written) const;
};

// The settings of a smart mapper that would override those of the fixed-point mapper inside it. As with MapperSettings,
// they are written to the members directly.
struct SmartSettings
{
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool InteractiveAdjust = 0;
  float SampleDistance = -1.0f;

  static SmartSettings Read(vtkSmartVolumeMapper* mapper);
  void Write(vtkSmartVolumeMapper* mapper) const;
  SmartSettings Keeping(const SmartSettings& now, const SmartSettings& written) const;
};

// Claims a mapper for `who`, the object that steers it; returns false if another object has claimed the mapper.
// ReleaseClaim() releases all claims of `who`.
bool ClaimMapper(const vtkVolumeMapper* mapper, const void* who);
void ReleaseClaim(const void* who);
}

#endif
