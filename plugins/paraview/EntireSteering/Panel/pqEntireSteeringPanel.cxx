// SPDX-License-Identifier: MIT OR Apache-2.0
#include "pqEntireSteeringPanel.h"

#include "pqActiveObjects.h"
#include "pqApplicationCore.h"
#include "pqFileDialog.h"
#include "pqRenderView.h"
#include "pqServerManagerModel.h"
#include "vtkNew.h"
#include "vtkPVRenderView.h"
#include "vtkSMPropertyHelper.h"
#include "vtkSMProxy.h"
#include "vtkSMSessionProxyManager.h"
#include "vtkSMViewProxy.h"
#include "vtkSmartPointer.h"

#include <QCheckBox>
#include <QComboBox>
#include <QDoubleSpinBox>
#include <QFormLayout>
#include <QHBoxLayout>
#include <QLabel>
#include <QLineEdit>
#include <QMap>
#include <QPointer>
#include <QPushButton>
#include <QSignalBlocker>
#include <QToolButton>
#include <QVBoxLayout>

#include <cmath>

struct pqEntireSteeringPanel::pqInternals
{
  QPointer<pqRenderView> View;
  // One steering per view, kept until the view is removed.
  QMap<pqView*, vtkSmartPointer<vtkSMProxy>> Proxies;
  // Read-outs: ParaView reads the values of Proxies in the client, and the values of Remotes on the server if a server
  // draws.
  QMap<pqView*, vtkSmartPointer<vtkSMProxy>> Remotes;
  // Number of frames of each proxy at the last update of the labels, and the proxy of the process that drew last.
  QMap<vtkSMProxy*, double> Seen;
  QPointer<pqRenderView> ReadView;
  vtkSMProxy* DrawnBy = nullptr;
  // Reason why steering of the view could not be turned on; empty if it could.
  QString Failure;
  QMetaObject::Connection Rendered;

  QCheckBox* On = nullptr;
  QDoubleSpinBox* Target = nullptr;
  QDoubleSpinBox* Step = nullptr;
  QDoubleSpinBox* ImageDistance = nullptr;
  QComboBox* Clock = nullptr;
  QLineEdit* Model = nullptr;
  QLabel* Predicted = nullptr;
  QLabel* Measured = nullptr;
  QLabel* Frame = nullptr;
  QLabel* Distances = nullptr;
  QLabel* Reason = nullptr;
  QLabel* Frames = nullptr;

  vtkSMProxy* Proxy() const { return this->Proxies.value(this->View.data()); }

  // The server whose disk has the view's files; nullptr if the client draws. The process that draws reads and writes the
  // files.
  pqServer* FileServer() const
  {
    auto* drawn = this->View ? vtkPVRenderView::SafeDownCast(this->View->getProxy()->GetClientSideObject()) : nullptr;
    return drawn && drawn->GetUseDistributedRenderingForRender() ? this->View->getServer() : nullptr;
  }
};

namespace
{
QDoubleSpinBox* Spin(
  double low, double high, double value, const QString& suffix, const QString& tip, const char* name)
{
  auto* box = new QDoubleSpinBox;
  box->setRange(low, high);
  box->setDecimals(1);
  box->setValue(value);
  box->setSuffix(suffix);
  box->setToolTip(tip);
  box->setObjectName(name);
  return box;
}

QString Milliseconds(double seconds)
{
  return std::isfinite(seconds) ? QString("%1 ms").arg(1e3 * seconds, 0, 'f', 1) : QString("-");
}
}

//-----------------------------------------------------------------------------
pqEntireSteeringPanel::pqEntireSteeringPanel(QWidget* parent, Qt::WindowFlags flags)
  : Superclass("Frame Time", parent, flags)
  , Internals(new pqInternals)
{
  this->setObjectName("EntireSteeringPanel");
  pqInternals& in = *this->Internals;
  auto* body = new QWidget(this);
  auto* column = new QVBoxLayout(body);
  in.On = new QCheckBox("Hold the frame time of this view");
  in.On->setObjectName("On");
  in.On->setToolTip("Steers volumes while the view is moved. Still renders are not changed.");
  column->addWidget(in.On);

  auto* form = new QFormLayout;
  in.Target = Spin(1, 10000, 100, " ms", "Target time of an interactive frame", "Target");
  in.Step = Spin(1, 64, 8, " voxels", "Coarsest distance of samples along rays, in smallest voxel spacings",
    "SampleDistance");
  in.ImageDistance = Spin(1, 16, 4, " pixels",
    "Coarsest distance of rays along each side of the image; 1 keeps its full resolution",
    "ImageSampleDistance");
  in.Clock = new QComboBox;
  in.Clock->addItems({ "Wall", "Process CPU" });
  in.Clock->setToolTip("Process CPU is for rendering on the CPU of a shared machine");
  in.Clock->setObjectName("Clock");
  in.Model = new QLineEdit;
  in.Model->setPlaceholderText("none: learned while rendering");
  in.Model->setObjectName("Model");
  auto* browse = new QToolButton;
  browse->setText("...");
  auto* file = new QHBoxLayout;
  file->addWidget(in.Model);
  file->addWidget(browse);
  form->addRow("Target", in.Target);
  form->addRow("Coarsest sample distance", in.Step);
  form->addRow("Coarsest image sample distance", in.ImageDistance);
  form->addRow("Clock", in.Clock);
  form->addRow("Model file", file);
  column->addLayout(form);

  auto* buttons = new QHBoxLayout;
  auto* save = new QPushButton("Save learned state...");
  auto* reset = new QPushButton("Discard learned state");
  buttons->addWidget(save);
  buttons->addWidget(reset);
  column->addLayout(buttons);

  auto* out = new QFormLayout;
  const auto label = [&](const QString& title, const char* name) {
    auto* text = new QLabel("-");
    text->setObjectName(name);
    text->setTextInteractionFlags(Qt::TextSelectableByMouse);
    out->addRow(title, text);
    return text;
  };
  in.Predicted = label("Predicted", "Predicted");
  in.Measured = label("Measured", "Measured");
  in.Frame = label("Whole frame", "Frame");
  in.Distances = label("Sample distances (ray, image)", "Distances");
  in.Reason = label("Why", "Reason");
  in.Reason->setWordWrap(true);
  in.Frames = label("Frames steered", "Frames");
  column->addLayout(out);
  column->addStretch();
  this->setWidget(body);

  connect(in.On, &QCheckBox::toggled, this, &pqEntireSteeringPanel::steer);
  for (QDoubleSpinBox* box : { in.Target, in.Step, in.ImageDistance })
  {
    connect(box, QOverload<double>::of(&QDoubleSpinBox::valueChanged), this, &pqEntireSteeringPanel::apply);
  }
  connect(in.Clock, QOverload<int>::of(&QComboBox::currentIndexChanged), this, &pqEntireSteeringPanel::apply);
  connect(in.Model, &QLineEdit::editingFinished, this, &pqEntireSteeringPanel::apply);
  connect(browse, &QToolButton::clicked, this, &pqEntireSteeringPanel::browse);
  connect(save, &QPushButton::clicked, this, &pqEntireSteeringPanel::save);
  connect(reset, &QPushButton::clicked, this, &pqEntireSteeringPanel::reset);
  connect(&pqActiveObjects::instance(), &pqActiveObjects::viewChanged, this, &pqEntireSteeringPanel::setView);
  connect(pqApplicationCore::instance()->getServerManagerModel(), &pqServerManagerModel::preViewRemoved, this,
    &pqEntireSteeringPanel::viewRemoved);
  this->setView(pqActiveObjects::instance().activeView());
}

//-----------------------------------------------------------------------------
pqEntireSteeringPanel::~pqEntireSteeringPanel() = default;

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::setView(pqView* view)
{
  pqInternals& in = *this->Internals;
  disconnect(in.Rendered);
  in.View = qobject_cast<pqRenderView*>(view);
  in.Failure.clear();
  this->widget()->setEnabled(in.View != nullptr);
  if (in.View)
  {
    in.Rendered = connect(in.View.data(), &pqView::endRender, this, &pqEntireSteeringPanel::readOut);
  }
  vtkSMProxy* proxy = in.Proxy();
  const QSignalBlocker quiet(in.On);
  in.On->setChecked(proxy && vtkSMPropertyHelper(proxy, "Enabled").GetAsInt() != 0);
  if (proxy)
  {
    const QSignalBlocker target(in.Target), step(in.Step), image(in.ImageDistance), clock(in.Clock);
    in.Target->setValue(1e3 * vtkSMPropertyHelper(proxy, "TargetFrameTime").GetAsDouble());
    in.Step->setValue(vtkSMPropertyHelper(proxy, "CoarsestSampleDistance").GetAsDouble());
    in.ImageDistance->setValue(vtkSMPropertyHelper(proxy, "CoarsestImageSampleDistance").GetAsDouble());
    in.Clock->setCurrentIndex(vtkSMPropertyHelper(proxy, "Clock").GetAsInt());
    in.Model->setText(vtkSMPropertyHelper(proxy, "ModelFileName").GetAsString());
  }
  this->readOut();
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::viewRemoved(pqView* view)
{
  pqInternals& in = *this->Internals;
  if (vtkSMProxy* proxy = in.Proxies.value(view))
  {
    vtkSMPropertyHelper(proxy, "View").RemoveAllValues();
    proxy->UpdateVTKObjects();
    if (vtkSMProxy* remote = in.Remotes.value(view))
    {
      vtkSMPropertyHelper(remote, "Source").RemoveAllValues();
      remote->UpdateVTKObjects();
      in.Seen.remove(remote);
      in.Remotes.remove(view);
    }
    in.Seen.remove(proxy);
    in.DrawnBy = nullptr;
    in.Proxies.remove(view);
  }
  if (in.View == view)
  {
    this->setView(nullptr);
  }
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::steer(bool on)
{
  pqInternals& in = *this->Internals;
  if (!in.View)
  {
    return;
  }
  if (on && !in.Proxy())
  {
    vtkSMSessionProxyManager* manager = in.View->getProxy()->GetSessionProxyManager();
    vtkSmartPointer<vtkSMProxy> made;
    made.TakeReference(manager->NewProxy("entire", "EntireSteering"));
    if (!made)
    {
      const QSignalBlocker quiet(in.On);
      in.On->setChecked(false);
      in.Failure = "the plugin is not loaded on the server; load EntireSteering there (Tools > Manage Plugins), then turn "
                   "steering on again";
      in.Reason->setText(in.Failure);
      return;
    }
    in.Failure.clear();
    vtkSMPropertyHelper(made, "View").Set(in.View->getProxy());
    in.Proxies[in.View.data()] = made;
    vtkSmartPointer<vtkSMProxy> remote;
    remote.TakeReference(manager->NewProxy("entire", "EntireSteeringReadOut"));
    if (remote)
    {
      made->UpdateVTKObjects();
      vtkSMPropertyHelper(remote, "Source").Set(made);
      remote->UpdateVTKObjects();
      in.Remotes[in.View.data()] = remote;
    }
  }
  this->apply();
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::apply()
{
  pqInternals& in = *this->Internals;
  vtkSMProxy* proxy = in.Proxy();
  if (!proxy)
  {
    return;
  }
  vtkSMPropertyHelper(proxy, "Enabled").Set(in.On->isChecked() ? 1 : 0);
  vtkSMPropertyHelper(proxy, "TargetFrameTime").Set(1e-3 * in.Target->value());
  vtkSMPropertyHelper(proxy, "CoarsestSampleDistance").Set(in.Step->value());
  vtkSMPropertyHelper(proxy, "CoarsestImageSampleDistance").Set(in.ImageDistance->value());
  vtkSMPropertyHelper(proxy, "Clock").Set(in.Clock->currentIndex());
  vtkSMPropertyHelper(proxy, "ModelFileName").Set(in.Model->text().toUtf8().data());
  proxy->UpdateVTKObjects();
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::browse()
{
  // The last argument turns off the grouping of files with numbered names.
  pqFileDialog dialog(
    this->Internals->FileServer(), this, "Model file", QString(), "Models (*.safetensors)", false);
  dialog.setObjectName("ModelFileDialog");
  dialog.setFileMode(pqFileDialog::ExistingFile);
  if (dialog.exec() == QDialog::Accepted && !dialog.getSelectedFiles().isEmpty())
  {
    this->Internals->Model->setText(dialog.getSelectedFiles().first());
    this->apply();
  }
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::save()
{
  vtkSMProxy* proxy = this->Internals->Proxy();
  const QString name =
    proxy ? pqFileDialog::getSaveFileName(this->Internals->FileServer(), this, "Save learned state") : QString();
  if (!name.isEmpty())
  {
    vtkSMPropertyHelper(proxy, "Save").Set(name.toUtf8().data());
    proxy->UpdateProperty("Save", 1);
  }
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::reset()
{
  if (vtkSMProxy* proxy = this->Internals->Proxy())
  {
    proxy->InvokeCommand("Reset");
  }
}

//-----------------------------------------------------------------------------
void pqEntireSteeringPanel::readOut()
{
  pqInternals& in = *this->Internals;
  vtkSMProxy* proxy = in.Proxy();
  if (!proxy)
  {
    for (QLabel* label : { in.Predicted, in.Measured, in.Frame, in.Distances, in.Reason, in.Frames })
    {
      label->setText("-");
    }
    if (!in.Failure.isEmpty())
    {
      in.Reason->setText(in.Failure);
    }
    return;
  }
  // Finds the process that drew the last frame: the client, or its server.
  if (in.ReadView != in.View)
  {
    in.ReadView = in.View;
    in.DrawnBy = nullptr;
  }
  for (vtkSMProxy* each : { proxy, in.Remotes.value(in.View.data()).GetPointer() })
  {
    if (each)
    {
      each->UpdatePropertyInformation();
      const double frames = vtkSMPropertyHelper(each, "NumberOfSteeredFrames").GetAsDouble() +
        vtkSMPropertyHelper(each, "NumberOfFallbackFrames").GetAsDouble();
      if (!in.DrawnBy || frames != in.Seen.value(each))
      {
        in.DrawnBy = each;
      }
      in.Seen[each] = frames;
    }
  }
  proxy = in.DrawnBy;
  const auto number = [&](const char* name) { return vtkSMPropertyHelper(proxy, name).GetAsDouble(); };
  const QString reason = vtkSMPropertyHelper(proxy, "Reason").GetAsString();
  const QString status = vtkSMPropertyHelper(proxy, "Status").GetAsString();
  in.Reason->setText(status.isEmpty() ? reason : reason + ": " + status);
  in.Frames->setText(QString::number(number("NumberOfSteeredFrames")));
  // A still frame follows interactive ones: the labels keep the values of the last interactive frame.
  if (reason == "still" || !in.On->isChecked())
  {
    return;
  }
  in.Predicted->setText(Milliseconds(number("PredictedTime")));
  in.Measured->setText(Milliseconds(number("MeasuredTime")));
  in.Frame->setText(Milliseconds(number("FrameTime")));
  in.Distances->setText(
    QString("%1, %2").arg(number("SampleDistance"), 0, 'f', 2).arg(number("ImageSampleDistance"), 0, 'f', 1));
}
