// SPDX-License-Identifier: MIT OR Apache-2.0
// Access to volume mappers: which of them draw, their settings, and who changes these settings for a frame.
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
// A mapper that draws, the smart mapper that it is inside of, if any, and whether it is a
// vtkGPUVolumeRayCastMapper; else it is a vtkFixedPointVolumeRayCastMapper.
struct LeafMapper
{
  vtkVolumeMapper* Mapper;
  vtkSmartVolumeMapper* Outer;
  bool Gpu;
};

// Adds the mappers that draw: the given one, or those inside it. Adds none for a mapper of another class.
void FindLeafMappers(vtkAbstractVolumeMapper* mapper, std::vector<LeafMapper>& found);

// The reason why a mapper cannot be steered with its current settings; empty if it can.
std::string Refusal(vtkAbstractVolumeMapper* mapper);

// True if a GPU mapper jitters ray starts, or lights samples by scattering: the same rays then take another time. `gpu` is
// that of its LeafMapper.
bool Jitters(vtkVolumeMapper* mapper, bool gpu);
bool Scatters(vtkVolumeMapper* mapper, bool gpu);

// The sample distance of a mapper that is locked to the spacing of its input.
double SpacingAdjustedSampleDistance(vtkVolumeMapper* mapper, vtkImageData* image);

// The settings of a mapper that steering changes. `gpu` is that of its LeafMapper.
//
// They are written to the members directly, without an event, and the mapper's MTime stays: the GPU mapper would
// compose its shader again if it moved, and reads its distances in every frame anyway. They are the mapper's for one
// frame only.
struct MapperSettings
{
  float SampleDistance = 1.0f;
  float ImageSampleDistance = 1.0f;
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool Lock = 0;

  static MapperSettings Read(vtkVolumeMapper* mapper, bool gpu);
  void Write(vtkVolumeMapper* mapper, bool gpu) const;
  // These settings, except those of `now` that differ from `written`: another caller has changed them since.
  MapperSettings Keeping(const MapperSettings& now, const MapperSettings& written) const;
};

// The settings of a smart mapper that would override those of the fixed-point mapper inside it. Written like those of
// mappers.
struct SmartSettings
{
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool InteractiveAdjust = 0;
  float SampleDistance = -1.0f;

  static SmartSettings Read(vtkSmartVolumeMapper* mapper);
  void Write(vtkSmartVolumeMapper* mapper) const;
  SmartSettings Keeping(const SmartSettings& now, const SmartSettings& written) const;
};

// Claims a mapper for one steering: false if another than `who` has claimed it.
bool ClaimMapper(const vtkVolumeMapper* mapper, const void* who);
void ReleaseClaim(const void* who);
}

#endif
