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

// The reason for which a mapper cannot be steered as it is told to draw now; empty where it can.
std::string Refusal(vtkAbstractVolumeMapper* mapper);

// A GPU mapper's rays begin at noise, or its samples are lit by scattering: the same rays cost another time. `gpu` is
// that of its LeafMapper.
bool Jitters(vtkVolumeMapper* mapper, bool gpu);
bool Scatters(vtkVolumeMapper* mapper, bool gpu);

// The sample distance that a mapper takes where it is locked to the spacing of its input.
double SpacingAdjustedSampleDistance(vtkVolumeMapper* mapper, vtkImageData* image);

// The settings of a mapper that steering changes. `gpu` is that of its LeafMapper.
//
// They are written to the members themselves: nobody is told, and the mapper's MTime stays. They are the mapper's
// for one frame only, and the GPU mapper, which looks at its distances in every frame, composes its shader again
// where its MTime has moved.
struct MapperSettings
{
  float SampleDistance = 1.0f;
  float ImageSampleDistance = 1.0f;
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool Lock = 0;

  static MapperSettings Read(vtkVolumeMapper* mapper, bool gpu);
  void Write(vtkVolumeMapper* mapper, bool gpu) const;
  // These settings, but those of `now` that are not as they were `written`: somebody else changed them since.
  MapperSettings Keeping(const MapperSettings& now, const MapperSettings& written) const;
};

// The settings of a smart mapper that would undo those of the fixed-point mapper inside it. Written as those of
// mappers are.
struct SmartSettings
{
  vtkTypeBool AutoAdjust = 0;
  vtkTypeBool InteractiveAdjust = 0;
  float SampleDistance = -1.0f;

  static SmartSettings Read(vtkSmartVolumeMapper* mapper);
  void Write(vtkSmartVolumeMapper* mapper) const;
  SmartSettings Keeping(const SmartSettings& now, const SmartSettings& written) const;
};

// The settings of a mapper are changed by one at a time: false where another than `who` has claimed the
// mapper.
bool ClaimMapper(const vtkVolumeMapper* mapper, const void* who);
void ReleaseClaim(const void* who);
}

#endif
