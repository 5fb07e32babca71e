// SPDX-License-Identifier: MIT OR Apache-2.0
/**
 * @class   vtkEntireViewSteering
 * @brief   holds every volume of a render view to a frame time
 *
 * Before each frame, it attaches a vtkEntireSteering with the settings below to each volume that the view draws
 * and that has none yet. Interactive frames are steered; ParaView draws still frames and screenshots without
 * steering. In a parallel server every rank steers the part of the volume that it draws, by its own clock.
 */
#ifndef vtkEntireViewSteering_h
#define vtkEntireViewSteering_h

#include "vtkEntireViewSteeringModule.h" // for export macro
#include "vtkObject.h"

#include <memory> // for std::unique_ptr

class vtkPVRenderView;

class VTKENTIREVIEWSTEERING_EXPORT vtkEntireViewSteering : public vtkObject
{
public:
  static vtkEntireViewSteering* New();
  vtkTypeMacro(vtkEntireViewSteering, vtkObject);
  void PrintSelf(ostream& os, vtkIndent indent) override;

  /**
   * Sets the view whose volumes are steered; nullptr releases it. The view is not kept alive.
   */
  void SetView(vtkPVRenderView* view);

  /**
   * Sets a source: another steering in this process, whose values the getters below then return. nullptr, the default,
   * means that they return the values of this steering. The source is not kept alive.
   */
  void SetSource(vtkEntireViewSteering* source);

  ///@{
  /**
   * Settings as in vtkEntireSteering. Changes take effect in the next frame.
   */
  vtkSetMacro(Enabled, bool);
  vtkGetMacro(Enabled, bool);
  vtkSetClampMacro(TargetFrameTime, double, 0.0, 10000.0);
  vtkGetMacro(TargetFrameTime, double);
  vtkSetClampMacro(CoarsestSampleDistance, double, 1.0 / 64, 4096.0);
  vtkGetMacro(CoarsestSampleDistance, double);
  vtkSetClampMacro(CoarsestImageSampleDistance, double, 1.0, 100.0);
  vtkGetMacro(CoarsestImageSampleDistance, double);
  vtkSetClampMacro(Clock, int, 0, 1);
  vtkGetMacro(Clock, int);
  vtkSetFilePathMacro(ModelFileName);
  vtkGetFilePathMacro(ModelFileName);
  ///@}

  ///@{
  /**
   * A file with a learned state from which steering starts; nullptr or an empty name for none. It is read when it is
   * set, and for each volume that is attached later, in the processes that draw the view.
   */
  void SetStateFileName(VTK_FILEPATH const char* fileName);
  vtkGetFilePathMacro(StateFileName);
  ///@}

  /**
   * Writes the learned state of the volume that took longest in the last frame. Returns false on failure. Of the
   * processes that draw the view, only the first rank writes. The other ranks, and a client whose server draws, return
   * true.
   */
  bool SaveState(VTK_FILEPATH const char* fileName);

  /**
   * Discards the learned state.
   */
  void Reset();

  ///@{
  /**
   * Values of the last frame in this process, as in vtkEntireSteering, for the volume that took longest. The numbers of
   * frames are sums over all volumes.
   */
  double GetPredictedTime();
  double GetMeasuredTime();
  double GetFrameTime();
  double GetSampleDistance();
  double GetImageSampleDistance();
  double GetObserverTime();
  const char* GetReason();
  const char* GetStatus();
  vtkIdType GetNumberOfSteeredFrames();
  vtkIdType GetNumberOfFallbackFrames();
  ///@}

protected:
  vtkEntireViewSteering();
  ~vtkEntireViewSteering() override;

  bool Enabled = true;
  double TargetFrameTime = 0.1;
  double CoarsestSampleDistance = 8.0;
  double CoarsestImageSampleDistance = 4.0;
  int Clock = 0;
  char* ModelFileName = nullptr;
  char* StateFileName = nullptr;

private:
  vtkEntireViewSteering(const vtkEntireViewSteering&) = delete;
  void operator=(const vtkEntireViewSteering&) = delete;

  class vtkInternals;
  std::unique_ptr<vtkInternals> Internals;
};

#endif
